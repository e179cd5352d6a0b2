"""Damaged and hostile inputs: how many are rejected in one line, accepted, or do harm.

    python -m benchmarks.fuzz [--kind npz models captures] [--count N] [--out FILE]

Seeds are fixed, so that case number n is the same in each run; `--only` repeats some cases of one kind and prints their
messages. Each input has 20 s. The exit code is 1 if an input led to a traceback, a hang, a crash, more than 2 GB of
memory, or other numbers than it should.
"""

import os
import sys

from benchmarks.common.parser import make_parser
from benchmarks.common.record import print_table, write_results
from benchmarks.fuzzing import KINDS
from benchmarks.fuzzing.runner import run_cases, run_here, summary

COLUMNS = (
    "kind inputs rejected_in_one_line accepted accepted_with_other_numbers traceback hang crash above_2_gb slowest_s"
)


def main() -> None:
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    parser = make_parser("fuzz", __doc__, kind=tuple(KINDS), count=3000, processes=os.cpu_count() or 1, only=[0])
    parser.set_defaults(only=None)
    options = parser.parse_args()
    if options.only is not None:
        for row in run_here(options.kind[0], options.only):
            print(f"{row['number']} {row['case']}: {row['outcome']} in {row['s']:.1f} s: {row['message']}")
        return
    rows = []
    for kind in options.kind:
        rows.append(summary(kind, run_cases(kind, options.count, options.processes)))
        write_results(options, count=options.count, kinds=rows)
    print_table(rows, COLUMNS)
    for row in rows:
        for bad in row["bad"][:20]:
            print(f"{row['kind']} {bad['number']} ({bad['case']}): {bad['outcome']}: {bad['message'][-300:]}")
    if any(row["bad"] for row in rows):
        sys.exit("error: some inputs were not answered as they should")


if __name__ == "__main__":
    main()
