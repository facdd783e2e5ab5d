"""The settings of a run: defaults < configs/<scene>.toml < command line; every run writes what came out, and it is read back here.

Settings are frozen dataclasses (`options`), checked against their ranges (`ranges`), read from TOML and JSON (`files`); tyro turns them
into options (`command_line`: `--losses.adversarial 0.5`). A [methods.NAME] table of a TOML file holds what differs for one method.
"""

from rtc_mjx.config.command_line import from_command_line
from rtc_mjx.config.files import defaults, read, write
from rtc_mjx.config.options import OF_RECOVERY, OF_VALUE, Config, Experts, Intervals, differing, flat, later, to_dict, unread
from rtc_mjx.config.ranges import check

__all__ = [
    "OF_RECOVERY",
    "OF_VALUE",
    "Config",
    "Experts",
    "Intervals",
    "check",
    "defaults",
    "differing",
    "flat",
    "from_command_line",
    "later",
    "read",
    "to_dict",
    "unread",
    "write",
]
