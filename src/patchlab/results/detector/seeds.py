"""The four scenes of promises.toml with other seeds: what each design gains over its best control.

Out: a line of seeds.csv for each object and seed. Run in this folder: python seeds.py 0 1 2
"""

import csv
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import patchproof as pp

OBJECTS = "truck", "carton", "chair", "mailbox"
HEAD = "object", "seed", "promised", "control", "beside_it", "gain", "low", "high"


def main(seeds: list[int]) -> None:
    """Each seed's four objects."""
    with Path("seeds.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEAD)
        for seed in seeds:
            for name in OBJECTS:
                with TemporaryDirectory() as folder:
                    run = pp.optimize(f"{name}.toml", Path(folder) / "run", seed=seed, compute=pp.Compute(jobs=2))
                promise = run.promise
                best = promise.controls[promise.best_control]
                figures = promise.rate, best.rate, best.difference, *best.difference_interval
                rate, beside, *gain = (round(figure, 4) for figure in figures)
                writer.writerow((name, seed, rate, promise.best_control, beside, *gain))
                file.flush()


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]])
