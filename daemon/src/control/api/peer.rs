//! Where a request comes from: another machine, or an account of this one.

use std::fs;
use std::net::SocketAddr;

use nix::unistd::{Uid, geteuid};
use tokio::net::TcpStream;

use crate::claim::name_of;

/// First account of a person; lower ones are those of the system (Debian policy, 9.2.2).
const PERSONS_FROM: u32 = 1000;
/// The account `nobody`, which some proxies use.
const NOBODY: u32 = 65_534;

/// Source of a request.
#[derive(Debug, Clone, Copy)]
pub(super) enum Peer {
    /// It came over TLS, or through the socket of a reverse proxy.
    Elsewhere,
    /// It came to the loopback port. The owner of the connection's other end; `None` if it is unknown.
    Here(Option<Uid>),
}

impl Peer {
    /// The client of a connection to the loopback port.
    pub fn of_loopback(stream: &TcpStream) -> Self {
        let ends = stream.peer_addr().and_then(|client| Ok((client, stream.local_addr()?)));
        Self::Here(ends.ok().and_then(|(client, service)| owner(client, service)))
    }

    /// Name of the system account that sends the request, as a reverse proxy does: neither root nor that of the service.
    pub fn system_account(self) -> Option<String> {
        let Self::Here(Some(user)) = self else { return None };
        let is_system = user.as_raw() < PERSONS_FROM || user.as_raw() == NOBODY;
        (is_system && !user.is_root() && user != geteuid()).then(|| name_of(user))
    }
}

/// Owner of a socket of this machine, by its own address and that of its other end (`/proc/net/tcp`, proc(5)).
fn owner(own: SocketAddr, other: SocketAddr) -> Option<Uid> {
    let (own, other) = (in_table(own)?, in_table(other)?);
    let owner_in = |line: &str| -> Option<Uid> {
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        let (local, remote, user) = (fields.get(1)?, fields.get(2)?, fields.get(7)?);
        // An IPv6 socket has the IPv4 address at the end of its own.
        let is_socket = local.ends_with(&own) && remote.ends_with(&other);
        if is_socket { user.parse().ok().map(Uid::from_raw) } else { None }
    };
    ["/proc/net/tcp", "/proc/net/tcp6"]
        .into_iter()
        .filter_map(|table| fs::read_to_string(table).ok())
        .find_map(|table| table.lines().find_map(owner_in))
}

/// An IPv4 address and port as the kernel's table has them: hexadecimal, the address in the byte order of the machine.
fn in_table(address: SocketAddr) -> Option<String> {
    let SocketAddr::V4(address) = address else { return None };
    Some(format!("{:08X}:{:04X}", u32::from_ne_bytes(address.ip().octets()), address.port()))
}
