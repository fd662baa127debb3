"""A spare process becomes the module that is started first, and never outlives its parent."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely")
TOLD = """
import json, os, sys
def main():
    told = {"pid": os.getpid(), "has": "fractions" in sys.modules, "word": os.environ["WORD"], "in": sys.stdin.read()}
    os.write(int(sys.argv[1]), json.dumps(told).encode())
    sys.exit(3) if told["word"] == "fail" else None
if __name__ == "__main__":
    main()
"""
PARENT = """
import fractions, json, os, signal, subprocess, sys, time
from hal import spare_process as spares
def start(word):
    out, into = os.pipe()
    process = spares.start_module("told", (into,), {"WORD": word})
    os.close(into)
    told = json.loads(os.read(out, 1000))
    return {**told, "same": told["pid"] == process.pid, "code": process.wait(60.0), "again": process.poll()}
"""


def run(folder: Path, body: str) -> Any:
    """Run a parent in an interpreter of its own and return what it prints."""
    (folder / "told.py").write_text(TOLD, encoding="utf-8")
    command = [sys.executable, "-c", PARENT + body]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        stdin=subprocess.DEVNULL,
        env={"PYTHONPATH": f"{Path(__file__).parents[2]}:{folder}"},
    )
    return json.loads(done.stdout)


def test_the_first_module_starts_in_the_spare_process_with_its_libraries_and_the_next_one_in_a_new_one(
    tmp_path: Path,
) -> None:
    body = "spares.keep_spare(); first = start('one'); print(json.dumps([first, start('two')]))"
    first, second = run(tmp_path, body)
    assert (first["has"], first["word"], first["in"], first["same"], first["code"]) == (True, "one", "", True, 0)
    assert (second["has"], second["word"], second["in"], second["same"], second["code"]) == (False, "two", "", True, 0)


@pytest.mark.parametrize("keeps", ["spares.keep_spare()", ""])
def test_the_exit_code_of_a_module_is_told_however_it_was_started(tmp_path: Path, keeps: str) -> None:
    told = run(tmp_path, f"{keeps}\nprint(json.dumps(start('fail')))")
    assert told["code"] == told["again"] == 3


def test_a_spare_process_that_has_died_is_replaced_by_a_new_one(tmp_path: Path) -> None:
    body = """
spares.keep_spare()
pid = spares._kept[0].process.pid
spares._kept[0].process.kill()
killed = spares._kept[0].process.wait(60.0)
told = start('on')
print(json.dumps([killed, told["code"], told["has"]]))
"""
    assert run(tmp_path, body) == [-9, 0, False]


def test_a_spare_process_ends_when_it_is_dropped_and_when_its_parent_ends(tmp_path: Path) -> None:
    body = """
spares.keep_spare()
process = spares._kept[0].process
spares.drop_spare()
spares.drop_spare()
spares.keep_spare()
print(json.dumps([process.poll(), spares._kept[0].process.pid]))
"""
    code, left = run(tmp_path, body)
    assert code == 0
    for _ in range(6000):  # it reads the end of its parent from the socket; a busy machine may take a while
        try:
            stat = Path(f"/proc/{left}/stat").read_text(encoding="utf-8")
        except (FileNotFoundError, ProcessLookupError):
            break
        if stat.rpartition(")")[2].split()[0] == "Z":
            break
        subprocess.run(["sleep", "0.01"], check=True)
    else:
        pytest.fail("the spare process outlives its parent")
