"""The command line: parses, runs one command, and turns errors into one line and an exit code."""

from __future__ import annotations

import json
import os
import sys
import traceback

from .errors import JaxmocapError


def main() -> None:
    """Exits 0, with 2 and one line on stderr for bad input, or with 1 for a bug."""
    if sys.argv[1:2] in (["pack"], ["unpack"]):
        # Their steps are small: XLA would spend more on handing them to its threads than the threads save.
        os.environ.setdefault("NPROC", "1")
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """The exit code of one command line."""
    from .commands import parse

    command = parse(arguments)
    try:
        report = command.run()
        if command.json or not command.writes_stdout:
            shown = json.dumps(report) if command.json else command.text(report)
            print(shown, file=sys.stderr if command.writes_stdout else sys.stdout, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("jaxmocap: interrupted", file=sys.stderr)
        return 130
    except (JaxmocapError, OSError, MemoryError) as error:
        print(f"jaxmocap: {_one_line(error)}", file=sys.stderr)
        return 2
    except Exception:
        traceback.print_exc()
        print("jaxmocap: this is a bug; please report it with the lines above", file=sys.stderr)
        return 1
    return 0


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    main()
