"""The best CVaR on five scenes of lava-grid, by a programme that shares nothing with the solver of the project:

    python3 tests/data/scene_optima.py > tests/data/scene_optima.json

It needs Python 3.11 and NumPy, and takes a minute. max_pi CVaR_a = max_w { w - min_pi E[(w - J)^+] / a }: every attainable
return w is tried, and for each the least shortfall is a dynamic programme over cells and time, since what a running episode has
paid so far is a function of the time alone.
"""

import json
import pathlib
import tomllib

import numpy as np

SCENES = ["strait", "detour", "two-goals", "lava-crossing-s9n2", "chow-gap"]
ETAS = [1, 25, 100]
FOLDER = pathlib.Path(__file__).parents[2] / "configs" / "scenes"


def solve(name: str) -> list[float]:
    scene = tomllib.loads((FOLDER / f"{name}.toml").read_text())
    constants = {
        "slip": 0.05, "step_cost": 0.035, "goal_reward": 1.0, "lesser_goal_reward": 0.5, "lava_reward": -1.0, "horizon": 40,
    }  # fmt: skip
    constants |= {key: value for key, value in scene.items() if key in constants}
    constants |= scene.get("lava-grid", {})
    cost, horizon, slip = constants["step_cost"], constants["horizon"], constants["slip"]
    rows = [line.strip() for line in scene["map"].split("\n") if line.strip()]
    ends = {"G": constants["goal_reward"], "g": constants["lesser_goal_reward"], "L": constants["lava_reward"]}
    height, width = len(rows), len(rows[0])
    start = next((y, x) for y in range(height) for x in range(width) if rows[y][x] == "S")

    # For each executed move, the cell that it leads to, and what it pays if it ends the episode there.
    target = np.zeros((4, height, width), dtype=int)
    pays = np.full((height, width), np.nan)
    for y in range(height):
        for x in range(width):
            if rows[y][x] in ends:
                pays[y, x] = ends[rows[y][x]]
            for move, (dy, dx) in enumerate([(-1, 0), (1, 0), (0, 1), (0, -1)]):
                v, u = y + dy, x + dx
                inside = 0 <= v < height and 0 <= u < width and rows[v][u] != "#"
                target[move, y, x] = (v * width + u) if inside else (y * width + x)
    law = np.full((4, 4), slip / 3) + np.eye(4) * (1 - slip - slip / 3)

    # What has been paid before step t, and every return.
    before = [-cost * t for t in range(horizon + 1)]
    returns = {before[t] + end for t in range(horizon) for end in ends.values()} | {before[horizon]}
    flat_pays = pays.ravel()

    def shortfall(w: float) -> float:
        later = np.full(height * width, max(0.0, w - before[horizon]))
        for t in reversed(range(horizon)):
            ended = np.maximum(0.0, w - (before[t] + flat_pays))
            entered = np.where(np.isnan(flat_pays), later, ended)
            later = (law @ entered[target.reshape(4, -1)]).min(axis=0)
        return float(later[start[0] * width + start[1]])

    candidates = sorted(returns)
    found = {w: shortfall(w) for w in candidates}
    return [max(w - eta * found[w] for w in candidates) for eta in ETAS]


print(json.dumps({"etas": ETAS, "scenes": {name: solve(name) for name in SCENES}}, indent=1))
