"""Runs a program under the system call filter of a systemd unit: unit_filter.py UNIT PROGRAM [ARGUMENT...]

systemd itself need not run. `systemd-analyze` lists its sets of system calls. The lines of the unit are applied to the kernel
in systemd's order (systemd.exec(5)). A call outside the filter kills the program; under the unit it would return EPERM. If the
program handled EPERM, a call that is missing in the filter would go unnoticed.
"""

import ctypes
import os
import subprocess
import sys

KILL_PROCESS, ALLOW = 0x80000000, 0x7FFF0000


def sets():
    """System calls and nested sets that each named set contains."""
    found = {}
    listing = subprocess.run(["systemd-analyze", "syscall-filter"], check=True, capture_output=True, text=True).stdout
    for line in listing.splitlines():
        if line.startswith("@"):
            members = found.setdefault(line.strip(), [])
        elif line.startswith("    ") and not line.strip().startswith("#"):
            members.append(line.strip())
    return found


def expand(name, known):
    if not name.startswith("@"):
        return {name}
    return set().union(*(expand(member, known) for member in known[name]))


def allowed(unit, known):
    """System calls that the unit allows: those of the first line and @default. Further lines add or, with ~, remove calls."""
    calls = set()
    for line in unit.splitlines():
        key, _, value = line.partition("=")
        if key == "SystemCallFilter":
            named = set().union(*(expand(name, known) for name in value.lstrip("~").split()))
            assert calls or not value.startswith("~"), "a list of what is denied is not read here"
            calls = calls - named if value.startswith("~") else (calls or expand("@default", known)) | named
    return calls


def apply(calls):
    seccomp = ctypes.CDLL("libseccomp.so.2")
    seccomp.seccomp_init.restype = ctypes.c_void_p
    seccomp.seccomp_rule_add.argtypes = [ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int, ctypes.c_uint]
    seccomp.seccomp_load.argtypes = [ctypes.c_void_p]
    rules = seccomp.seccomp_init(KILL_PROCESS)
    for call in calls:
        number = seccomp.seccomp_syscall_resolve_name(call.encode())
        # A negative number is a call of another architecture.
        assert number < 0 or seccomp.seccomp_rule_add(rules, ALLOW, number, 0) == 0, call
    assert seccomp.seccomp_load(rules) == 0, "the kernel takes no filter"


unit, program, *arguments = sys.argv[1:]
with open(unit, encoding="utf-8") as file:
    calls = allowed(file.read(), sets())
assert calls, f"{unit} has no SystemCallFilter"
apply(calls)
os.execvp(program, [program, *arguments])
