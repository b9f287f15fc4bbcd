"""Reference values for `src/report/statistics.rs`, from rliable and SciPy.

    python3 -m venv /tmp/venv && /tmp/venv/bin/pip install rliable==1.2.0 scipy 'pandas<3' statsmodels
    /tmp/venv/bin/python tests/data/statistics_reference.py > tests/data/statistics_reference.json

The correction of p values that of statsmodels.
"""

import json
import sys
from importlib.metadata import version

import numpy as np
import scipy.stats
import scipy.stats.mstats
from rliable import metrics
from statsmodels.stats.multitest import multipletests

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


few_rates = [(0, 3), (1, 3), (0, 10), (2, 10), (10, 10), (1, 20)]
p_values = [[0.01], [0.04, 0.001, 0.03, 0.5], [0.2, 0.2, 0.9], [0.012, 0.011, 0.013, 0.02, 0.0]]


def yuen(s):
    """The interval of a trimmed mean: the t statistic of Yuen (1974) for one sample."""
    cut, n = len(s) // 4, len(s)
    left = n - 2 * cut
    winsorised = scipy.stats.mstats.winsorize(np.sort(s), limits=((cut + 1e-9) / n, (cut + 1e-9) / n))
    error = np.sqrt(np.var(winsorised, ddof=1) * (n - 1) / (left * (left - 1)))
    return list(map(float, scipy.stats.t.interval(0.95, left - 1, scipy.stats.trim_mean(s, 0.25), error)))


json.dump(
    {
        "made_by": {name: version(name) for name in ("rliable", "scipy", "numpy", "statsmodels")},
        "samples": [
            {
                "values": s.tolist(),
                "iqm": float(scipy.stats.trim_mean(s, 0.25)),
                "rliable_iqm": float(metrics.aggregate_iqm(s[:, None])),
                "iqm_interval": yuen(s) if len(s) > 1 else None,
                "mean": float(s.mean()),
                "median": float(np.median(s)),
            }
            for s in samples
        ],
        "wilson": [
            {"successes": k, "trials": n, "interval": list(scipy.stats.binomtest(k, n).proportion_ci(method="wilson"))}
            for k, n in rates
        ],
        "clopper_pearson": [
            {"successes": k, "trials": n, "interval": list(scipy.stats.binomtest(k, n).proportion_ci(method="exact"))}
            for k, n in few_rates
        ],
        "holm": [{"p": p, "corrected": multipletests(p, method="holm")[1].tolist()} for p in p_values],
        "student": [{"freedom": f, "quantile": float(scipy.stats.t.ppf(0.975, f))} for f in (1, 2, 3, 4, 9, 10, 29, 100)],
        "paired": [
            {
                "x": x.tolist(),
                "y": y.tolist(),
                "difference": float(np.mean(x - y)),
                "interval": list(map(float, scipy.stats.ttest_rel(x, y).confidence_interval(0.95))),
                "p": float(scipy.stats.ttest_rel(x, y).pvalue),
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
    },
    sys.stdout,
    indent=1,
)
print()
