"""Reference values for `src/report/statistics.rs`, from rliable and SciPy.

    python3 -m venv /tmp/venv && /tmp/venv/bin/pip install rliable==1.2.0 scipy 'pandas<3'
    /tmp/venv/bin/python tests/data/statistics_reference.py > tests/data/statistics_reference.json

Takes about a minute: the bootstraps are long, so that their own noise stays out of the third digit.
"""

import json
import sys
from importlib.metadata import version

import numpy as np
import scipy.stats
from rliable import library, metrics

REPLICATES = 100_000
# This statistic is slow, and discrete, so that its quantiles hardly move with the replicates.
REPLICATES_OF_IMPROVEMENT = 20_000

random = np.random.RandomState(20_260_101)

samples = [np.round(random.normal(0.4, 0.2, n), 6) for n in (1, 2, 3, 4, 5, 7, 8, 10, 13)]

# Scores of runs x tasks, skewed as returns are: most seeds near the optimum, some far below.
scores = np.round(0.5 - random.exponential(0.06, (10, 2)) + np.array([0.0, 0.1]), 6)
baseline = np.round(0.47 - random.exponential(0.06, (8, 2)) + np.array([0.0, 0.1]), 6)
tied_x = np.array([[0.1], [0.2], [0.2], [0.5]])
tied_y = np.array([[0.2], [0.2], [0.1]])

paired = [
    (np.round(random.normal(0.1, 0.05, n), 6), np.round(random.normal(0.05, 0.05, n), 6))
    for n in (2, 3, 10)
]

rates = [(0, 10), (1, 10), (10, 10), (7, 1_000), (800, 100_000), (0, 100_000)]


def interval(score, metric, replicates=REPLICATES):
    _, intervals = library.get_interval_estimates(
        {"x": score},
        lambda *s: np.array([metric(*s)]),
        reps=replicates,
        random_state=np.random.RandomState(7),
    )
    return [float(v) for v in intervals["x"][:, 0]]


json.dump(
    {
        "made_by": {name: version(name) for name in ("rliable", "scipy", "numpy", "arch")},
        "replicates": REPLICATES,
        "samples": [
            {
                "values": s.tolist(),
                "iqm": float(scipy.stats.trim_mean(s, 0.25)),
                "rliable_iqm": float(metrics.aggregate_iqm(s[:, None])),
                "mean": float(s.mean()),
                "median": float(np.median(s)),
            }
            for s in samples
        ],
        "wilson": [
            {"successes": k, "trials": n, "interval": list(scipy.stats.binomtest(k, n).proportion_ci(method="wilson"))}
            for k, n in rates
        ],
        "student": [{"freedom": f, "quantile": float(scipy.stats.t.ppf(0.975, f))} for f in (1, 2, 3, 4, 9, 10, 29, 100)],
        "paired": [
            {
                "x": x.tolist(),
                "y": y.tolist(),
                "difference": float(np.mean(x - y)),
                "interval": list(map(float, scipy.stats.ttest_rel(x, y).confidence_interval(0.95))),
            }
            for x, y in paired
        ],
        "improvement": [
            {
                # One list of runs for each task.
                "x": x.T.tolist(),
                "y": y.T.tolist(),
                "probability": float(metrics.probability_of_improvement(x, y)),
            }
            for x, y in ((scores, baseline), (tied_x, tied_y))
        ],
        "bootstrap": {
            "x": scores.T.tolist(),
            "y": baseline.T.tolist(),
            "mean": interval(scores, metrics.aggregate_mean),
            "iqm": interval(scores, metrics.aggregate_iqm),
            "improvement": interval(
                (scores, baseline), metrics.probability_of_improvement, REPLICATES_OF_IMPROVEMENT
            ),
        },
    },
    sys.stdout,
    indent=1,
)
print()
