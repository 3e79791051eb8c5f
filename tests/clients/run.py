"""`make clients`: the programs that our files are for open them, and a value that each computes equals ours.

Each client is installed by its pins into an environment that it shares with no other. A client that cannot be had is
skipped with a reason; one that is there and fails, or computes another value, makes the exit code 1. The table is
printed, and written as OUT/table.md and OUT/clients.json.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from clients import CLIENTS, Client, Skipped
from inputs import Values, make_inputs

from spike4dgs.benchmark.files import write_json, write_text

HERE = Path(__file__).resolve().parent
_INSTALL_S, _RUN_S = 1800, 600
COLUMNS = ("client", "version", "opens", "value", "numbers")
COLUMNS += ("mean, theirs", "mean, ours", "largest difference", "allowed")


@dataclass(frozen=True)
class Row:
    """A value of a client next to ours; without numbers, why there are none."""

    client: str
    version: str
    opens: str
    state: str  # equal, differs, failed or skipped
    reason: str = ""
    value: str = ""
    numbers: int = 0
    theirs: float | None = None
    ours: float | None = None
    difference: float | None = None
    allowed: float | None = None

    def cells(self) -> list[str]:
        """Return the row of the table."""
        if self.theirs is None or self.ours is None:
            return [self.client, self.version, self.opens, f"{self.state}: {self.reason}", *[""] * 5]
        numbers = f"{self.theirs:.7g}", f"{self.ours:.7g}", f"{self.difference:.2g}", f"{self.allowed:g}"
        mark = "" if self.state == "equal" else " (differs)"
        return [self.client, self.version, self.opens, self.value + mark, str(self.numbers), *numbers]


def compare(client: Client, version: str, theirs: Values, ours: Values) -> list[Row]:
    """Return a row for each of our values: equal where all numbers are there and none is farther than allowed."""
    rows = []
    for name, allowed in client.values.items():
        a, b = np.asarray(theirs.get(name, ()), float), np.asarray(ours[name], float)
        if a.shape != b.shape or not b.size:
            reason = f"{a.size} numbers for {name}, expected {b.size}"
            rows.append(Row(client.name, version, client.opens, "failed", reason))
            continue
        difference = float(np.abs(a - b).max())
        state = "equal" if difference <= allowed else "differs"  # NaN differs
        means = float(a.mean()), float(b.mean())
        rows.append(Row(client.name, version, client.opens, state, "", name, b.size, *means, difference, allowed))
    return rows


def check(client: Client, inputs: Path, homes: Path) -> list[Row]:
    """Install a client, run its script on the inputs, and compare."""
    version, support = client.version, str(HERE.parent / "support")  # for `cpu_torchvision`, which needs torch alone
    env = {**os.environ, "PYTHONNOUSERSITE": "1", "PYTHONPATH": support}
    try:
        if client.prepare:
            version, env = client.prepare(inputs, homes, env)
        python, env = install(client, homes, env)
    except (Skipped, OSError, subprocess.SubprocessError) as e:
        return [Row(client.name, version, client.opens, "skipped", reason_of(e))]
    answer = inputs / f"{client.name}.json"
    command = [str(python), str(HERE / client.script), str(inputs), str(answer)]
    try:
        subprocess.run(command, env=env, check=True, capture_output=True, text=True, timeout=_RUN_S)
        return compare(client, version, json.loads(answer.read_text()), client.ours(inputs))
    except (subprocess.SubprocessError, OSError, ValueError) as e:
        return [Row(client.name, version, client.opens, "failed", reason_of(e))]


def reason_of(error: Exception) -> str:
    """Return one line: of a program its last, which says what was wrong."""
    text = getattr(error, "stderr", None) or str(error)
    lines = [line for line in str(text).splitlines() if line.strip() and not line.startswith(("WARNING", "npm notice"))]
    errors = [line for line in lines if line.startswith("ERROR")]
    return (errors or lines or [type(error).__name__])[-1].strip().replace("|", "/")[:300]


def install(client: Client, homes: Path, env: dict[str, str]) -> tuple[Path, dict[str, str]]:
    """Return the interpreter for a client's script, and its environment; a finished installation is used again."""
    home = homes / client.name
    pins = hashlib.sha256(json.dumps([client.packages, client.bare, client.npm, sys.version]).encode()).hexdigest()
    stamp = home / "installed"
    done = stamp.is_file() and stamp.read_text() == pins
    if not done:
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
    if client.npm:
        if not shutil.which("npm"):
            raise Skipped("needs Node: no npm here")
        if not done:
            run(["npm", "install", "--no-audit", "--no-fund", "--prefix", str(home), *client.npm])
        env = {**env, "PATH": os.pathsep.join((str(home / "node_modules/.bin"), env["PATH"]))}
        python = Path(sys.executable)
    else:
        python = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        if not done:
            run([sys.executable, "-m", "venv", str(home)])
            run([*pip, *client.packages])
            if client.bare:
                run([*pip, "--no-deps", *client.bare])
    stamp.write_text(pins)
    return python, env


def run(command: list[str]) -> None:
    """Run a command of an installation."""
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=_INSTALL_S)


def table(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    lines = [COLUMNS, ["---"] * len(COLUMNS), *(row.cells() for row in rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def main() -> int:
    """Check all clients, or those of --only."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[client.name for client in CLIENTS], default=[])
    parser.add_argument("--homes", type=Path, default=Path(".clients"), help="where clients are installed")
    parser.add_argument("--out", type=Path, default=Path("runs/clients"))
    options = parser.parse_args()
    chosen = [client for client in CLIENTS if client.name in options.only or not options.only]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder).resolve()
        make_inputs(inputs)
        for client in chosen:
            print(f"{client.name} {client.version}", file=sys.stderr, flush=True)
            found = check(client, inputs, options.homes.resolve())
            for row in found:
                print(f"  {row.state} {row.value} {row.reason}", file=sys.stderr, flush=True)
            rows += found
    write_text(options.out / "table.md", table(rows))
    write_json(options.out / "clients.json", {"clients": [asdict(row) for row in rows]})
    print(table(rows), end="")
    return int(any(row.state in ("differs", "failed") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
