"""The commands, one a file; each is a dataclass whose fields are its arguments."""

from __future__ import annotations

from .base import Command
from .bench import Bench
from .compare import Compare
from .decode import Decode
from .demo import Demo
from .encode import Encode
from .export import Export
from .info import Info
from .ls import Ls
from .pack import Pack
from .train import Train
from .unpack import Unpack
from .view import View

COMMANDS: dict[str, type[Command]] = {
    "demo": Demo,
    "info": Info,
    "encode": Encode,
    "decode": Decode,
    "compare": Compare,
    "pack": Pack,
    "unpack": Unpack,
    "ls": Ls,
    "train": Train,
    "export": Export,
    "view": View,
    "bench": Bench,
}


def parse(arguments: list[str]) -> Command:
    """The command of an argument list; prints help or a usage error and exits where there is none."""
    import tyro

    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="jaxmocap", description="Learned transforms for motion capture.", args=arguments
    )
