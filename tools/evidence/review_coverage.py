"""How often the review's 95 % interval holds the truth, on simulated cameras: the table of docs/evidence/review.md.

    python tools/evidence/review_coverage.py --scenes 20 --points 6

For each kind of sensor (``tests/addons/review/sensors.py``) and each distance, over flat, tilted and curved surfaces:
the share of true points within 1.96 standard errors, and the root mean square of distance / error (1 where errors are
right).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))  # the simulated cameras are those of the tests

from tests.addons.review.coverage import covered
from tests.addons.review.sensors import DISTANCES_MM, SENSORS, SURFACES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10, help="of each distance and shape (default: 10)")
    parser.add_argument("--points", type=int, default=6, help="of each scene (default: 6)")
    parser.add_argument("--clouds", type=int, default=8, help="of each scene (default: 8)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensors", nargs="*", choices=list(SENSORS), default=list(SENSORS))
    options = parser.parse_args()
    print(f"| sensor | all | {' | '.join(f'{mm} mm' for mm in DISTANCES_MM)} | {' | '.join(SURFACES)} | points |")
    print("|" + "---|" * (3 + len(DISTANCES_MM) + len(SURFACES)))
    for sensor in options.sensors:
        ratios = {}
        for mm in DISTANCES_MM:
            for kind in SURFACES:
                found = covered(sensor, kind, mm, options.clouds, options.scenes, options.points, options.seed)
                ratios[mm, kind] = found[:, 0] / found[:, 1]
        cells = [np.concatenate(list(ratios.values()))]
        cells += [np.concatenate([ratios[mm, kind] for kind in SURFACES]) for mm in DISTANCES_MM]
        cells += [np.concatenate([ratios[mm, kind] for mm in DISTANCES_MM]) for kind in SURFACES]
        shown = [f"{np.mean(np.abs(cell) <= 1.96):.0%} ({np.sqrt(np.mean(cell**2)):.2f})" for cell in cells]
        print(f"| {sensor} | {' | '.join(shown)} | {len(cells[0])} |", flush=True)


if __name__ == "__main__":
    main()
