"""The commands, one a file; each is a dataclass whose fields are its arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import tyro

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
from .stream import StreamDecode, StreamEncode
from .train import Train
from .unpack import Unpack
from .view import View


def stream(
    what: tyro.conf.OmitArgPrefixes[
        Annotated[StreamEncode, tyro.conf.subcommand("encode", prefix_name=False)]
        | Annotated[StreamDecode, tyro.conf.subcommand("decode", prefix_name=False)]
    ],
) -> Command:
    """Encode and decode frame by frame, through files, pipes and the network."""
    return what


COMMANDS: dict[str, Callable[..., Command]] = {
    "demo": Demo,
    "info": Info,
    "encode": Encode,
    "decode": Decode,
    "compare": Compare,
    "pack": Pack,
    "unpack": Unpack,
    "ls": Ls,
    "stream": stream,
    "train": Train,
    "export": Export,
    "view": View,
    "bench": Bench,
}


def parse(arguments: list[str]) -> Command:
    """The command of an argument list; prints help or a usage error and exits where there is none."""
    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="jaxmocap", description="Learned transforms for motion capture.", args=arguments
    )
