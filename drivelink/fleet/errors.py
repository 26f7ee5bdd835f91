"""What can be wrong with a whole fleet run. What is wrong with one recording is a row of its table."""

from drivelink.errors import DrivelinkError

__all__ = ["FleetError"]


class FleetError(DrivelinkError):
    """The scheduler, the joint folder or the result folder is not what it has to be."""

    exit_status = 3
