#!/usr/bin/env bash
# Tests the Debian package in a clean root directory. The package is installed, upgraded, removed and purged. Its service
# runs with only the rights that its unit grants.
#
# Usage: daemon/tests/package.sh [PROFILE], as root. Needs cargo-deb, debootstrap, iproute2 and systemd, and Debian's mirror.
# The bus is the simulated segment at the other end of a virtual cable, in a network of its own. tests/unit_filter.py applies
# the system call filter of the unit.
set -euo pipefail
cd "$(dirname "$0")/../.."
if [ "${PACKAGE_TEST:-}" != inside ]; then
  exec env PACKAGE_TEST=inside unshare --mount "$0" "$@"
fi
profile=${1:-release}
root=${PACKAGE_ROOT:-target/package-root}
network=ballbard-package
# Capability and limits of the unit. If limits cannot be raised here, as in some containers, capabilities replace them.
capabilities=+net_raw effective=0000000000002000 limits=(prlimit --rtprio=99 --memlock=unlimited)
if ! "${limits[@]}" true 2>/dev/null; then
  echo "limits cannot be raised here; CAP_SYS_NICE and CAP_IPC_LOCK stand for them"
  capabilities+=,+sys_nice,+ipc_lock effective=0000000000806000 limits=()
fi

step() { printf '\n== %s\n' "$1"; }
fail() { echo "FAILED: $1" >&2; exit 1; }
inside() { ip netns exec "$network" chroot "$root" "$@"; }
admin() { chroot "$root" "$@"; }
wait_for() { # what, command...
  local what=$1; shift
  for _ in $(seq 100); do if "$@" >/dev/null 2>&1; then return; fi; sleep 0.2; done
  fail "$what never came"
}

# Applies these settings of the unit: User, AmbientCapabilities, CapabilityBoundingSet,
# NoNewPrivileges, limits, WorkingDirectory, StateDirectory, SystemCallFilter.
as_the_unit=(ip netns exec "$network" chroot "$root" "${limits[@]}"
  setpriv --reuid=ballbard --regid=ballbard --clear-groups --no-new-privs
  --bounding-set="-all,$capabilities" --inh-caps="-all,$capabilities" --ambient-caps="-all,$capabilities"
  env -C /var/lib/ballbard STATE_DIRECTORY=/var/lib/ballbard
  python3 /tmp/unit_filter.py /tmp/ballbard.service)
is_ready() { inside ballbard status | grep -q '^READY$'; }

step "a clean root and two packages, the second as an upgrade"
[ -x "$root/usr/bin/apt-get" ] || debootstrap --variant=minbase bookworm "$root" >/dev/null
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
for revision in 1 2; do
  cp "$(daemon/debian/build "$profile" "$version-$revision" | tail -1)" "$root/tmp/$revision.deb"
done
dpkg-deb --info "$root/tmp/1.deb"
ip netns add "$network"
trap 'kill $(jobs -p) 2>/dev/null; ip netns del "$network"; admin dpkg --purge ballbard >/dev/null 2>&1 || true' EXIT

step "install"
admin apt-get -qq update
admin apt-get install -y -qq --no-install-recommends /tmp/1.deb
for file in /etc/ballbard/daemon.toml /etc/default/ballbard /usr/share/man/man1/ballbard-run.1.gz \
  /usr/share/man/man1/identify-calibrate.1.gz /usr/share/bash-completion/completions/ballbard \
  /usr/share/bash-completion/completions/identify /usr/share/doc/ballbard/copyright; do
  [ -e "$root$file" ] || fail "$file is missing"
done
inside identify --version
[ "$(stat -c %U "$root/var/lib/ballbard")" = "$(stat -c %U "$root/var/tmp/ballbard")" ] || fail "directories of two owners"

step "the unit"
unit=$(mktemp -d)/ballbard.service
sed "s|^ExecStart=|&$(realpath "$root")|" daemon/debian/ballbard.service > "$unit"
systemd-analyze verify --man=no "$unit"
systemd-analyze security --offline=yes --threshold=30 "$unit" | tail -1

step "without an interface it ends with what to set, and is not restarted"
grep -q '^RestartPreventExitStatus=2$' daemon/debian/ballbard.service || fail "it would be restarted"
(. "$root/etc/default/ballbard"; [ -z "${BALLBARD_OPTIONS:-}" ]) || fail "the package assumes an interface"
# The program finds /etc/ballbard without an option.
code=0
inside env STATE_DIRECTORY=/var/lib/ballbard ballbard run 2>"$root/tmp/usage.log" || code=$?
[ "$code" = 2 ] || fail "exit code $code without an interface"
grep -q "/etc/default/ballbard" "$root/tmp/usage.log" || fail "no word of what to set"

step "run with what the unit grants, and no more"
admin apt-get install -y -qq --no-install-recommends python3 systemd
cp daemon/tests/unit_filter.py daemon/debian/ballbard.service "$root/tmp/"
ip -n "$network" link set lo up
ip -n "$network" link add near type veth peer name far
ip -n "$network" link set near up
ip -n "$network" link set far up
# Does not use `inside`, because ending the job would then end only the shell of `inside`.
ip netns exec "$network" chroot "$root" ballbard segment --interface far </dev/null >/dev/null 2>&1 &
"${as_the_unit[@]}" ballbard run --config /etc/ballbard --bus near >/dev/null 2>"$root/tmp/service.log" &
service=$!
wait_for "the bus" is_ready
grep -q "^CapEff:.$effective\$" "/proc/$service/status" || fail "other capabilities than those"
check=$(inside ballbard check) || fail "check: $check"
echo "$check"
for subject in bus encoders state disk "real time"; do
  grep -q "^ok *$subject:" <<<"$check" || fail "check: $subject"
done
grep -q "clock.*does not report" <<<"$check" && fail "check: clock"
inside ballbard start --name first
sleep 3
inside ballbard stop
inside ballbard runs | grep first

step "upgrade under a run, which goes on"
echo "# of this machine" >> "$root/etc/ballbard/daemon.toml"
inside ballbard start --name second
admin dpkg -i /tmp/2.deb
grep -q "of this machine" "$root/etc/ballbard/daemon.toml" || fail "the configuration was replaced"
inside ballbard status | grep -q RECORDING || fail "the upgrade ended the run"
inside ballbard stop
kill -TERM "$service"
wait "$service" || fail "the service did not end well"
[ "$(admin dpkg-query -W -f '${Version}' ballbard)" = "$version-2" ] || fail "not upgraded"

step "remove: what was measured, found and configured stays"
"${as_the_unit[@]}" touch homing.toml
admin dpkg --remove ballbard
[ ! -e "$root/usr/bin/ballbard" ] || fail "the program is still there"
for file in /etc/ballbard/daemon.toml /var/lib/ballbard/runs/first.mcap /var/lib/ballbard/runs/second.mcap \
  /var/lib/ballbard/homing.toml; do
  [ -e "$root$file" ] || fail "$file is gone"
done

step "purge: only what was measured stays"
admin dpkg --purge ballbard
[ ! -e "$root/etc/ballbard" ] || fail "/etc/ballbard is still there"
[ ! -e "$root/var/lib/ballbard/homing.toml" ] || fail "homing.toml is still there"
ls -l "$root/var/lib/ballbard/runs"
[ -e "$root/var/lib/ballbard/runs/second.mcap" ] || fail "recordings are gone"
rm -r "$root/var/lib/ballbard"
step "all is well"
