"""Faults from outside: processes killed while caches are written, damaged files, random
properties and random command lines.

    python -m experiments.robustness.faults.run [--kills 60] [--files 1000]
        [-o output]      (make stress)

Writes output/faults/results.json and prints both tables. Exits with 1 if a cache was lost, or if a
reader crashed, hung or raised anything but an IrrcacheError.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi

from experiments.robustness.faults.formats import FORMATS, Format
from experiments.robustness.faults.fuzz import Tally, try_files
from experiments.robustness.faults.kills import kill_renders
from mitsuba_irrcache.compare.results import write_json
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.machine.llvm import require_llvm


def main() -> int:
    """Run both parts and print the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--files", type=int, default=1000, help="of each format, cases included")
    parser.add_argument("--only", action="append", default=[], help="a format; repeatable")
    parser.add_argument("-o", "--output", type=Path, default=Path("output"))
    args = parser.parse_args()
    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    chosen = [f for f in FORMATS if not args.only or f.name in args.only]
    tallies = {format_.name: fuzz(format_, args.files) for format_ in chosen}
    print(tabulated(tallies).as_text())
    for name, tally in tallies.items():
        for error in tally.errors[:5]:
            print(f"  {name}: {error}")
    with tempfile.TemporaryDirectory() as folder:
        toll = kill_renders(Path(folder), args.kills)
    print(
        f"\n{toll.kills} kills, {toll.while_writing} of them while the cache was written: caches "
        f"lost {toll.lost}, runs that did not go on {toll.not_continued}"
    )
    target = args.output / "faults"
    target.mkdir(parents=True, exist_ok=True)
    rows = {name: tally.row() for name, tally in tallies.items()}
    write_json(target / "results.json", {"files": rows, "kills": asdict(toll)})
    failed = toll.lost or toll.not_continued or any(t.failed for t in tallies.values())
    return 1 if failed else 0


def fuzz(format_: Format, count: int) -> Tally:
    """Test mutants of a valid file; only the file itself may appear in its folder."""
    with tempfile.TemporaryDirectory() as folder:
        valid = Path(folder) / "valid" / format_.name
        target = Path(folder) / "mutants"
        for path in (valid.parent, target):
            path.mkdir()
        format_.make(valid)
        for other in valid.parent.iterdir():
            (target / other.name).write_bytes(other.read_bytes())
        before = {p.name for p in target.iterdir()}
        tally = try_files(valid, format_.mutate, format_.read, count, target)
        strange = {p.name for p in target.iterdir()} - before
        if strange:
            tally.errors.append(f"files were written: {', '.join(sorted(strange))}")
        return tally


def tabulated(tallies: dict[str, Tally]) -> Table:
    """Tabulate a row for each format."""
    rows = [
        [name, *map(str, (t.tried, t.read, t.refused, t.crashes, t.hangs, len(t.errors),
                          t.peak_megabytes))]
        for name, t in tallies.items()
    ]  # fmt: skip
    head = ["format", "tried", "read", "refused", "crashes", "hangs", "other errors", "peak MB"]
    return Table("Files, scenes and command lines that were tampered with", head, rows)


if __name__ == "__main__":
    sys.exit(main())
