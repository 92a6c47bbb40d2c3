"""The commands of the README do what it says."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    if not README.is_file():
        pytest.skip("the README is not beside the tests here")
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), re.DOTALL)


def test_shell_commands_run(tmp_path: Path):
    (script,) = blocks("sh")
    for line in script.strip().splitlines():
        program, *arguments = shlex.split(line)
        assert program == "jaxmocap"
        done = subprocess.run(
            [sys.executable, "-m", "jaxmocap", *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, f"{line}: {done.stderr}"
    assert (tmp_path / "out/demo/player.html").is_file()
    assert (tmp_path / "second.bvh").read_text().count("\n") > 120
    assert (tmp_path / "walk.html").is_file()


def test_python_runs(capsys: pytest.CaptureFixture[str]):
    (code,) = blocks("python")
    exec(compile(code, "README.md", "exec"), {})
    size, error = capsys.readouterr().out.split()
    assert int(size) < 2000 and 0.5 < float(error) <= 1.0


def test_links_lead_somewhere():
    if not README.is_file():
        pytest.skip("the README is not beside the tests here")
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target
