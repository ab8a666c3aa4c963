#!/usr/bin/env python3
"""Forward kinematics by programs that are independent of this project, for tests.

    forward.py urdf FILE BASE TIP     yourdfpy on a URDF; joints in the order from BASE to TIP
    forward.py dh                     products of matrices of a Denavit-Hartenberg table

Reads JSON from standard input: rows of joint variables [rad, m] under "joints"; for `dh` also "convention" ("standard" or
"modified") and "links": [prismatic, a [m], alpha [rad], d [m], theta [rad]]. Writes a JSON list of 4 x 4 matrices.
"""
import json
import sys

import numpy as np


def of_urdf(path, base, tip, rows):
    import yourdfpy

    robot = yourdfpy.URDF.load(path, load_meshes=False, build_scene_graph=True)
    above = {joint.child: joint for joint in robot.robot.joints}
    names, link = [], tip
    while link != base:
        joint = above[link]
        if joint.type != "fixed":
            names.insert(0, joint.name)
        link = joint.parent
    for row in rows:
        robot.update_cfg(dict(zip(names, row)))
        yield robot.get_transform(tip, base)


def turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[j, i], matrix[i, j] = s, -s
    return matrix


def shift(axis, length):
    matrix = np.eye(4)
    matrix[axis, 3] = length
    return matrix


def of_table(convention, links, rows):
    for row in rows:
        pose = np.eye(4)
        for (prismatic, a, alpha, d, theta), q in zip(links, row):
            theta, d = (theta, d + q) if prismatic else (theta + q, d)
            about_z = turn(2, theta) @ shift(2, d)
            about_x = turn(0, alpha) @ shift(0, a)
            pose = pose @ (about_z @ about_x if convention == "standard" else about_x @ about_z)
        yield pose


def main():
    asked = json.load(sys.stdin)
    if sys.argv[1] == "urdf":
        poses = of_urdf(*sys.argv[2:5], asked["joints"])
    else:
        poses = of_table(asked["convention"], asked["links"], asked["joints"])
    json.dump([np.asarray(pose).tolist() for pose in poses], sys.stdout)


main()
