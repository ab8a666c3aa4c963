"""Fits a robot directly to measured positions with pybotics, for tests.

Reads JSON from standard input. "links" has [a [m], alpha [rad], d [m], theta [rad]] in the standard convention. "fitted" and
"others" are lists of [joints [rad], position [m]]. The fit uses "fitted". For each of "nominal", "offsets" and "dh", writes the
root mean square distance of the positions in "others" [m].
"""
import json
import sys

import numpy as np
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.optimization import OptimizationHandler, compute_absolute_errors
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares


def placed(robot, seen):
    """World frame in which the positions of the robot are nearest to the measured ones."""
    own = np.array([robot.fk(q)[:3, 3] for q, _ in seen])
    there = np.array([position for _, position in seen])
    u, _, v = np.linalg.svd((there - there.mean(0)).T @ (own - own.mean(0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, there.mean(0) - turn @ own.mean(0)
    return frame


def errors(vector, handler, seen):
    """Errors of each coordinate. `optimize_accuracy` minimises the same sum, but its distances determine a step poorly."""
    handler.apply_optimization_vector(vector)
    return np.concatenate([handler.robot.fk(q)[:3, 3] - position for q, position in seen])


def main():
    asked = json.load(sys.stdin)
    links = asked["links"]
    # In the modified convention, length and twist precede the rotation about the joint. They are therefore
    # those of the previous link.
    before = [[0.0, 0.0]] + [[alpha, a] for a, alpha, _, _ in links]
    rows = [[*before[i], theta, d] for i, (_, _, d, theta) in enumerate(links)]
    alpha, a = before[-1]
    end = np.array([[1, 0, 0, a], [0, np.cos(alpha), -np.sin(alpha), 0], [0, np.sin(alpha), np.cos(alpha), 0], [0, 0, 0, 1]])
    seen = {which: [(np.array(q), np.array(p)) for q, p in asked[which]] for which in ("fitted", "others")}
    masks = {"nominal": [False] * 4, "offsets": [False, False, True, False], "dh": [True] * 4}
    found = {}
    for deployment, mask in masks.items():
        robot = Robot(MDHKinematicChain.from_parameters(np.array(rows).ravel()), Tool(end))
        robot.joint_limits = np.array([[-1e3] * len(links), [1e3] * len(links)])
        robot.world_frame = placed(robot, seen["fitted"])
        handler = OptimizationHandler(
            robot, kinematic_chain_mask=mask * len(links), tool_mask=[True] * 3 + [False] * 3, world_mask=True
        )
        start = handler.generate_optimization_vector()
        fitted = least_squares(errors, start, method="lm", ftol=1e-6, args=(handler, seen["fitted"]))
        handler.apply_optimization_vector(fitted.x)
        distances = compute_absolute_errors(*zip(*seen["others"]), handler.robot)
        found[deployment] = float(np.sqrt(np.mean(np.square(distances))))
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
