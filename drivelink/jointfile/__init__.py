"""Joint files: schema, hints for unknown keys, new files, changes by fit and diagnose."""

from drivelink.jointfile.document import MAX_BYTES as MAX_BYTES
from drivelink.jointfile.document import JointText as JointText
from drivelink.jointfile.document import changes_to as changes_to
from drivelink.jointfile.document import effect_entry as effect_entry
from drivelink.jointfile.document import fingerprint as fingerprint
from drivelink.jointfile.document import link_entry as link_entry
from drivelink.jointfile.document import load as load
from drivelink.jointfile.document import load_text as load_text
from drivelink.jointfile.document import parse as parse
from drivelink.jointfile.document import plain_parameters as plain_parameters
from drivelink.jointfile.document import read_text as read_text
from drivelink.jointfile.document import without_check as without_check
from drivelink.jointfile.document import write_model as write_model
from drivelink.jointfile.schema import BusSection as BusSection
from drivelink.jointfile.schema import ColumnSection as ColumnSection
from drivelink.jointfile.schema import DriveSection as DriveSection
from drivelink.jointfile.schema import EncoderSection as EncoderSection
from drivelink.jointfile.schema import JointFile as JointFile
from drivelink.jointfile.schema import LinkSection as LinkSection
from drivelink.jointfile.schema import MotorSection as MotorSection
from drivelink.jointfile.schema import RecordingSection as RecordingSection
from drivelink.jointfile.schema import Ros2Section as Ros2Section
from drivelink.jointfile.schema import SimSection as SimSection
from drivelink.jointfile.schema import TpdoSection as TpdoSection
from drivelink.jointfile.schema import ZenohSection as ZenohSection
