//! A network interface as a wire. A raw AF_PACKET socket sends and receives EtherCAT frames only. If the
//! interface is lost and later returns under the same name, the socket is opened again. A claim prevents a second
//! `ballbard` from using the interface.

use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::path::Path;

use nix::errno::Errno;
use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::socket::{AddressFamily, MsgFlags, SockFlag, SockType, recv, send, socket};
use nix::sys::time::TimeSpec;
use shared::time::{MonoNs, NS_PER_S};

use super::{FRAME_BYTES_MAX, FrameWire};
use crate::claim::{Claim, Holder};
use crate::clock::Clock;
use crate::tuning;

/// EtherType of EtherCAT (IEEE, ETG.1000.4).
const ETHERTYPE_ETHERCAT: u16 = 0x88a4;

/// Time between two attempts to reopen a lost interface \[ns\].
const REOPEN_PERIOD_NS: i64 = NS_PER_S / 10;

/// Why an interface cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// No interface has this name.
    #[error("network interface `{name}` not found; choose one of this machine: {}", available.join(", "))]
    NoSuchInterface {
        /// Name in the configuration.
        name: String,
        /// Names of the interfaces of this machine.
        available: Vec<String>,
    },
    /// A raw socket needs root or CAP_NET_RAW.
    #[error(
        "no permission to open a raw socket on `{name}`; type: {}",
        tuning::grant(tuning::is_package(Path::new("/")))
    )]
    Permission {
        /// Name of the interface.
        name: String,
    },
    /// Another `ballbard` uses the interface. Two MainDevices on one segment would disturb both runs.
    #[error("network interface `{name}` is in use by {holder}; stop that, or choose another interface")]
    InUse {
        /// Name of the interface.
        name: String,
        /// The process that uses it.
        holder: Holder,
    },
    /// Any other error of the operating system.
    #[error("cannot open network interface `{name}`: {source}; bring it up with `ip link set {name} up`")]
    System {
        /// Name of the interface.
        name: String,
        /// Error of the operating system.
        source: io::Error,
    },
}

/// A raw socket on one network interface.
#[derive(Debug)]
pub struct EthernetWire {
    name: String,
    socket: OwnedFd,
    clock: Clock,
    _claim: Option<Claim>,
    /// When the loss of the interface was noticed, or when reopening was last tried. `None` while the interface works.
    gone_since: Option<MonoNs>,
}

impl EthernetWire {
    /// Opens an interface by its name, in real time.
    pub fn open(name: &str) -> Result<Self, OpenError> {
        interface_index(name)?;
        let socket = open_socket(name).map_err(|source| refused(name, source))?;
        let claim =
            Claim::interface(name).map_err(|holder| OpenError::InUse { name: name.to_owned(), holder })?;
        Ok(Self { name: name.to_owned(), socket, clock: Clock::Real, _claim: claim, gone_since: None })
    }

    /// Opens a new socket if the interface was lost and has returned under the same name. Tries this at most
    /// every tenth of a second.
    fn reopen_if_gone(&mut self) {
        let Some(since) = self.gone_since else { return };
        let now = self.clock.now();
        if now.ns_since(since) < REOPEN_PERIOD_NS {
            return;
        }
        match open_socket(&self.name) {
            Ok(socket) => (self.socket, self.gone_since) = (socket, None),
            Err(_) => self.gone_since = Some(now),
        }
    }

    /// Converts an error. If the error is neither a full queue nor an interruption, the interface is down or
    /// lost, and this is remembered.
    fn note(&mut self, error: Errno) -> io::Error {
        if !matches!(error, Errno::EAGAIN | Errno::ENOBUFS | Errno::EINTR) {
            self.gone_since.get_or_insert(self.clock.now());
        }
        error.into()
    }

    /// Waits until a frame is available. Returns false if none is available by `until`.
    fn wait_readable(&self, until: MonoNs) -> io::Result<bool> {
        loop {
            let wait_ns = until.ns_since(self.clock.now()).max(0);
            let timeout = TimeSpec::new(wait_ns / NS_PER_S, wait_ns % NS_PER_S);
            match ppoll(&mut [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN)], Some(timeout), None) {
                Ok(ready) => return Ok(ready > 0),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

impl FrameWire for EthernetWire {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.reopen_if_gone();
        match send(self.socket.as_raw_fd(), frame, MsgFlags::MSG_DONTWAIT) {
            Ok(_) => Ok(()),
            Err(error) => Err(self.note(error)),
        }
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        self.reopen_if_gone();
        if !self.wait_readable(until)? {
            return Ok(None);
        }
        match recv(self.socket.as_raw_fd(), buffer, MsgFlags::MSG_DONTWAIT) {
            Ok(length) => Ok(Some(length)),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(None),
            Err(error) => Err(self.note(error)),
        }
    }
}

/// Current index of the interface with this name.
pub fn interface_index(name: &str) -> Result<libc::c_uint, OpenError> {
    if_nametoindex(name)
        .map_err(|_| OpenError::NoSuchInterface { name: name.to_owned(), available: interfaces() })
}

/// Opens a socket on the interface that currently has this name. Allocates no memory, because the thread of the cycle calls
/// this function for a lost interface.
fn open_socket(name: &str) -> io::Result<OwnedFd> {
    bind(unbound_socket()?, if_nametoindex(name)?)
}

fn refused(name: &str, source: io::Error) -> OpenError {
    let name = name.to_owned();
    match source.raw_os_error() {
        Some(libc::EPERM | libc::EACCES) => OpenError::Permission { name },
        _ => OpenError::System { name, source },
    }
}

/// Names of the interfaces of this machine, for error messages.
pub fn interfaces() -> Vec<String> {
    let all = nix::net::if_::if_nameindex();
    all.map(|all| all.iter().map(|one| one.name().to_string_lossy().into_owned()).collect())
        .unwrap_or_default()
}

/// Opens a packet socket that does not receive frames yet. The socket has no protocol. With a protocol, it would receive
/// frames of every interface until it is bound.
fn unbound_socket() -> io::Result<OwnedFd> {
    Ok(socket(AddressFamily::Packet, SockType::Raw, SockFlag::SOCK_CLOEXEC, None)?)
}

/// Binds a packet socket to one interface. From then on, the socket receives the EtherCAT frames of this interface.
#[allow(unsafe_code, reason = "neither std nor nix binds a packet socket to an interface and an EtherType")]
fn bind(socket: OwnedFd, index: libc::c_uint) -> io::Result<OwnedFd> {
    // SAFETY: a sockaddr_ll in which all bytes are zero is valid.
    let mut address: libc::sockaddr_ll = unsafe { std::mem::zeroed() };
    address.sll_family = libc::AF_PACKET as u16;
    address.sll_protocol = ETHERTYPE_ETHERCAT.to_be();
    address.sll_ifindex = i32::try_from(index).map_err(io::Error::other)?;
    let length = size_of::<libc::sockaddr_ll>() as libc::socklen_t;
    // SAFETY: the address lives until the call returns, and `length` is the length of the address.
    let bound = unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), length) };
    if bound < 0 { Err(io::Error::last_os_error()) } else { Ok(socket) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Needs CAP_NET_RAW. Uses the loopback interface, which exists on every machine.
    #[test]
    fn an_unbound_socket_receives_from_no_interface() {
        let Ok(mut other) = EthernetWire::open("lo") else {
            println!("skipped: no permission to open raw sockets");
            return;
        };
        let unbound = unbound_socket().unwrap();
        let mut frame = [0; 60];
        frame[12..14].copy_from_slice(&ETHERTYPE_ETHERCAT.to_be_bytes());
        frame[20..28].copy_from_slice(b"from lo!");
        other.send(&frame).unwrap();
        let received = |socket: OwnedFd, name: &str| {
            let clock = Clock::Real;
            let until = clock.now().plus_ns(NS_PER_S / 2);
            let mut wire = EthernetWire { name: name.into(), socket, clock, _claim: None, gone_since: None };
            let mut buffer = [0; FRAME_BYTES_MAX];
            // Other tests on this machine may send frames, too.
            std::iter::from_fn(|| {
                wire.receive(&mut buffer, until).unwrap().map(|_| buffer[20..28] == *b"from lo!")
            })
            .any(|ours| ours)
        };
        // The frame was sent, because a socket that was bound to the interface has received it.
        assert!(received(other.socket, "lo"));
        let bound = bind(unbound, if_nametoindex("lo").unwrap()).unwrap();
        assert!(!received(bound, "lo"));
    }
}
