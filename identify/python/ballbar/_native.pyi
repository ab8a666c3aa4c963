from os import PathLike
from typing import Union

_File = Union[str, "PathLike[str]"]

class Error(ValueError): ...

class Robot:
    def __new__(cls, calibration: _File, robot: _File, bar: _File | None = None) -> Robot: ...
    @property
    def axes(self) -> int: ...
    def forward(self, joints: bytes) -> bytes: ...
    def covariance(self, joints: bytes) -> bytes: ...
    def inverse(self, poses: bytes, near: bytes) -> bytes: ...

class RecordingTables:
    joints: bytes
    cycle: bytes
    time_ns: bytes
    time_uncertainty_ns: bytes
    flags: bytes
    origin: bytes
    count: bytes
    valid: bytes
    angle_rad: bytes
    events: list[tuple[int, int, str, str]]
    run: str
    end: str

def checksum(path: _File) -> str: ...
def run(words: list[str]) -> tuple[str, str]: ...
def read_recording(path: _File) -> RecordingTables: ...
