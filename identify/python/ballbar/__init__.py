"""Calibration of industrial robots with a sensed double ball-bar.

The functions run the commands of ``identify`` in this process. Their keywords are the options of the commands, such as
``robot_log=`` for ``--robot-log``. The value ``True`` sets an option that has no value, and a list repeats an option. The
logger ``ballbar`` logs the output of a command as information and its warnings as warnings. If a command refuses, an
:class:`Error` is raised.

Numbers are in SI units: metres, radians, and nanoseconds if the name ends in ``_ns``.
"""

from __future__ import annotations

import csv
import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._native import Error

__all__ = ["Calibration", "Error", "Event", "Recording", "Study", "calibrate", "read_recording", "simulate", "study"]

File = Union[str, "os.PathLike[str]"]
Option = Union[File, float, bool, None, np.generic, Sequence[Union[File, float, np.generic]]]
Numbers = NDArray[np.float64]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Event:
    """An event of a run."""

    time_ns: int
    cycle: int
    kind: str
    """``marker``, ``gap``, ``bus``, ``clock`` or ``disk``"""
    text: str


@dataclass(frozen=True)
class Recording:
    """A finished recording. Arrays have one row per cycle; arrays of encoders have one column per entry of ``joints``."""

    joints: tuple[int, ...]
    """The bar's joints that have an encoder, 1 to 5."""
    cycle: NDArray[np.uint64]
    time_ns: NDArray[np.int64]
    """Instants at which the encoders were sampled: UTC since 1970."""
    time_uncertainty_ns: NDArray[np.uint32]
    """Standard deviation of ``time_ns``."""
    flags: NDArray[np.uint32]
    """Reasons why a cycle cannot be used, as bits; 0 for a cycle without faults."""
    origin: NDArray[np.uint32]
    """Number of the counters' origin. Angles of two cycles are only comparable if this number is equal."""
    count: NDArray[np.uint32]
    """Counters of the terminals as recorded. They wrap at 32 bits."""
    valid: NDArray[np.bool_]
    angle_rad: Numbers
    """NaN where a count is not valid."""
    events: tuple[Event, ...]
    run: dict[str, Any]
    """Metadata of the run, such as operator, robot and settings."""
    end: dict[str, Any]
    """Cause and statistics of the end of the run."""


def read_recording(path: File) -> Recording:
    """Reads a recording that ``ballbard`` has finished."""
    found = _native.read_recording(path)
    encoders = len(found.joints)
    column = lambda table, kind: np.frombuffer(table, dtype=kind)
    return Recording(
        joints=tuple(found.joints),
        cycle=column(found.cycle, np.uint64),
        time_ns=column(found.time_ns, np.int64),
        time_uncertainty_ns=column(found.time_uncertainty_ns, np.uint32),
        flags=column(found.flags, np.uint32),
        origin=column(found.origin, np.uint32),
        count=column(found.count, np.uint32).reshape(-1, encoders),
        valid=column(found.valid, np.bool_).reshape(-1, encoders),
        angle_rad=column(found.angle_rad, np.float64).reshape(-1, encoders),
        events=tuple(Event(*event) for event in found.events),
        run=json.loads(found.run),
        end=json.loads(found.end),
    )


def simulate(out: File, *, instrument: str | None = None, **options: Option) -> Path:
    """``identify simulate``: writes an experiment and its known errors to the directory ``out``, and returns ``out``."""
    _run("simulate", *_named(instrument), *_options(out=out, **options))
    return Path(out)


def calibrate(*files: File, instrument: str | None = None, out: File | None = None, **options: Option) -> Calibration:
    """``identify calibrate``: calibrates a robot from measurements.

    ``calibrate(recording=.., robot_log=.., robot=.., bar=..)`` uses a run with the ball-bar. ``calibrate("grid.csv",
    instrument="tracker", mapping=.., robot=..)`` uses measured poses. ``calibrate(experiment=..)`` uses all data that an
    experiment file names. The report and all other files are written to ``out``. Without ``out`` they are removed at the end.
    """
    with _directory(out) as directory:
        _run("calibrate", *_named(instrument), *files, *_options(out=directory, **options))
        return Calibration(directory)


class Calibration:
    """A calibrated robot.

    ``directory`` is the directory that contains ``calibration.json``. This file names the configurations of robot and bar. If
    they were moved or changed since, ``robot`` and ``bar`` must name them.

    Arrays of postures have any shape; their last dimension is the joints of the robot [rad, m]. The robot is at rest in each
    posture. The end of the robot is its flange, or the end of the offset plate if a ball-bar measured.
    """

    file: dict[str, Any]
    """The content of ``calibration.json``."""

    def __init__(self, directory: File, *, robot: File | None = None, bar: File | None = None) -> None:
        path = Path(directory) / "calibration.json"
        try:
            self.file = json.loads(path.read_text(encoding="utf-8"))
            robot, bar = robot or self._input("robot"), bar or self._input("bar")
        except Error:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Error(f"{path} is not a calibration: {error}; give the directory that `identify calibrate` wrote") from error
        if robot is None:
            raise Error(f"{path} does not name its robot's configuration; give robot=")
        self._robot = _native.Robot(path, robot, bar)

    def _input(self, role: str) -> Path | None:
        named = next((one for one in self.file["inputs"] if one["role"] == role), None)
        if named is None:
            return None
        path = Path(named["path"])
        try:
            found = _native.checksum(path)
        except Error as error:
            raise Error(f"{error}; give {role}= the {role}'s configuration") from error
        if found != named["sha256"]:
            raise Error(f"{path} has changed since the calibration; give {role}= the {role}'s configuration as it was")
        return path

    @property
    def axes(self) -> int:
        """Number of axes of the robot."""
        return self._robot.axes

    @property
    def values(self) -> dict[str, float]:
        """Value of every parameter, by its name."""
        return {one["name"]: one["value"] for one in self.file["parameters"]}

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each parameter, by its name. Parameters that are assumed to be exact are not included."""
        return {one["name"]: one["sigma"] for one in self.file["parameters"] if one.get("sigma") is not None}

    def forward(self, joints: ArrayLike) -> Numbers:
        """Poses (.., 4, 4) of the robot's end in its base at the postures (.., axes)."""
        q = self._postures(joints)
        poses = _table(self._robot.forward(q.tobytes()), 4, 4)
        return poses.reshape(*q.shape[:-1], 4, 4)

    def inverse(self, poses: ArrayLike, near: ArrayLike) -> Numbers:
        """Postures (.., axes) that the robot reports at poses (.., 4, 4): the solutions nearest to ``near`` (.., axes)."""
        poses = _finite(poses, "poses")
        if poses.shape[-2:] != (4, 4):
            raise Error(f"poses have the shape {poses.shape}; give (.., 4, 4)")
        near = np.broadcast_to(self._postures(near), (*poses.shape[:-2], self.axes))
        return _table(self._robot.inverse(poses.tobytes(), near.tobytes()), self.axes).reshape(near.shape)

    def uncertainty(self, joints: ArrayLike) -> Numbers:
        """Covariances (.., 6, 6) of position [m] and rotation vector [rad] in the robot's base, at the postures (.., axes).

        Raises an error if a parameter of the robot is not identified.
        """
        q = self._postures(joints)
        return _table(self._robot.covariance(q.tobytes()), 6, 6).reshape(*q.shape[:-1], 6, 6)

    def _postures(self, joints: ArrayLike) -> Numbers:
        q = _finite(joints, "joints")
        if q.shape[-1:] != (self.axes,):
            raise Error(f"joints have the shape {q.shape}; give (.., {self.axes})")
        return q


@dataclass(frozen=True)
class Study:
    """Results of a study."""

    summary: dict[str, Any]
    """The content of ``summary.json``: every curve and every answer."""
    points: dict[str, NDArray[Any]]
    """Every estimate of the study: the columns of ``points.csv``."""


def study(*study: File, out: File | None = None, **options: Option) -> Study | None:
    """``identify study``: ``study("thesis")``, ``study("my.toml", seeds=3)``, ``study("merge", "shard-1", "shard-2", out="all")``.

    Returns None for a shard, because only merged shards have results.
    """
    with _directory(out) as directory:
        _run("study", *study, *_options(out=directory, **options))
        if options.get("shard") is not None:
            return None
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        with open(directory / "points.csv", newline="", encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
    kinds = {"trial": int, "seed": int, "figure": str, "series": str, "estimator": str, "failed": str}
    number = lambda text: float(text or "nan")
    names = rows[0] if rows else []
    return Study(summary, {name: np.array([kinds.get(name, number)(row[name]) for row in rows]) for name in names})


def _run(*words: File) -> None:
    said, warned = _native.run(["identify", *(os.fspath(word) for word in words)])
    for level, text in ((logging.INFO, said), (logging.WARNING, warned)):
        for line in text.splitlines():
            _log.log(level, line)


def _named(instrument: str | None) -> list[str]:
    return [] if instrument is None else [instrument]


def _options(**options: Option) -> Iterator[str]:
    for name, value in options.items():
        option = "--" + name.replace("_", "-")
        for one in value if isinstance(value, (list, tuple, np.ndarray)) else [value]:
            # A number of numpy, such as a seed of np.arange, is not an int.
            one = one.item() if isinstance(one, np.generic) else one
            if one is True:
                yield option
            elif one is not None and one is not False:
                yield f"{option}={one if isinstance(one, (int, float)) else os.fspath(one)}"


@contextmanager
def _directory(out: File | None) -> Iterator[Path]:
    if out is not None:
        yield Path(out)
        return
    with TemporaryDirectory(prefix="ballbar-") as directory:
        yield Path(directory)


def _finite(numbers: ArrayLike, name: str) -> Numbers:
    array = np.asarray(numbers, dtype=np.float64)
    if not np.isfinite(array).all():
        raise Error(f"{name} have numbers that are not finite")
    return array


def _table(table: bytes, *shape: int) -> Numbers:
    return np.frombuffer(table, dtype=np.float64).reshape(-1, *shape)
