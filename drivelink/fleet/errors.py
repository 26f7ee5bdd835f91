"""Errors of a whole fleet run. An error of one recording is a row of its table."""

from drivelink.errors import DrivelinkError


class FleetError(DrivelinkError):
    """The scheduler, the joint folder or the result folder cannot be used."""

    exit_status = 3
