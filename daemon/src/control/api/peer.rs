//! Finds out where a request comes from: from another machine, or from which user account of this machine.

use std::fs;
use std::net::SocketAddr;

use nix::unistd::{Uid, geteuid};
use tokio::net::TcpStream;

use crate::claim::name_of;

/// Lowest user id of a person's account. Lower ids are system accounts (Debian policy, 9.2.2).
const PERSONS_FROM: u32 = 1000;
/// User id of the account `nobody`, which some proxies use.
const NOBODY: u32 = 65_534;

/// Source of a request.
#[derive(Debug, Clone, Copy)]
pub(super) enum Peer {
    /// The request came over TLS, or through the socket of a reverse proxy.
    Elsewhere,
    /// The request came to the loopback port. The value is the user who owns the client's socket; `None` if it is unknown.
    Here(Option<Uid>),
}

impl Peer {
    /// Source of the requests of a connection to the loopback port.
    pub fn of_loopback(stream: &TcpStream) -> Self {
        let ends = stream.peer_addr().and_then(|client| Ok((client, stream.local_addr()?)));
        Self::Here(ends.ok().and_then(|(client, service)| owner(client, service)))
    }

    /// Name of the system account that sends the request; `None` for root, for the account of the service, and for people.
    /// Reverse proxies run as system accounts.
    pub fn system_account(self) -> Option<String> {
        let Self::Here(Some(user)) = self else { return None };
        let is_system = user.as_raw() < PERSONS_FROM || user.as_raw() == NOBODY;
        (is_system && !user.is_root() && user != geteuid()).then(|| name_of(user))
    }
}

/// Owner of a socket of this machine, found by the socket's address and the address of its other end
/// (`/proc/net/tcp`, proc(5)).
fn owner(own: SocketAddr, other: SocketAddr) -> Option<Uid> {
    let (own, other) = (in_table(own)?, in_table(other)?);
    let owner_in = |line: &str| -> Option<Uid> {
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        let (local, remote, user) = (fields.get(1)?, fields.get(2)?, fields.get(7)?);
        // The table of IPv6 sockets contains an IPv4 address as the end of a longer address, so only the ends are compared.
        let is_socket = local.ends_with(&own) && remote.ends_with(&other);
        if is_socket { user.parse().ok().map(Uid::from_raw) } else { None }
    };
    ["/proc/net/tcp", "/proc/net/tcp6"]
        .into_iter()
        .filter_map(|table| fs::read_to_string(table).ok())
        .find_map(|table| table.lines().find_map(owner_in))
}

/// Formats an IPv4 address and port as in the table of the kernel: hexadecimal, with the address in the
/// byte order of the machine.
fn in_table(address: SocketAddr) -> Option<String> {
    let SocketAddr::V4(address) = address else { return None };
    Some(format!("{:08X}:{:04X}", u32::from_ne_bytes(address.ip().octets()), address.port()))
}
