//! Pairs a phone: a QR code opens the page with a single-use code instead of the token. The route `pair` issues the code. The
//! gate of [`remote`](super::remote) redeems the code and stores the token in the browser of the phone.

use std::fmt::Display;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::Response;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::SockaddrStorage;
use qrcode::QrCode;
use qrcode::render::svg;
use rand::Rng;
use shared::time::MonoNs;
use subtle::ConstantTimeEq;

use super::fingerprint::{Fingerprint, hex};
use super::{ApiState, JsonBody, refusal};
use crate::control::status::{PairReply, PairRequest, PairingLink};

/// How long a code is valid. This is enough time to open the link on a phone and accept the certificate.
const VALID: Duration = Duration::from_secs(300);
/// Largest number of valid codes. A further code replaces the oldest.
const CODES_MAX: usize = 8;
/// Length of a code \[bytes\]. A code of this length cannot be guessed while it is valid.
const CODE_BYTES: usize = 16;

/// Issues and redeems codes.
#[derive(Debug)]
pub(super) struct Pairing {
    address: SocketAddr,
    fingerprint: Fingerprint,
    /// Codes and the times at which they were issued, the oldest first.
    codes: Mutex<Vec<(String, MonoNs)>>,
}

impl Pairing {
    /// Creates a pairing for clients that connect to this address, whose certificate has this fingerprint.
    pub fn new(address: SocketAddr, fingerprint: Fingerprint) -> Self {
        Self { address, fingerprint, codes: Mutex::default() }
    }

    /// The codes that are valid at this time.
    fn codes(&self, now: MonoNs) -> MutexGuard<'_, Vec<(String, MonoNs)>> {
        let mut codes = self.codes.lock().unwrap_or_else(PoisonError::into_inner);
        codes.retain(|(_, issued)| now.ns_since(*issued) < VALID.as_nanos() as i64);
        codes
    }

    /// Issues a code that is valid from now on.
    fn issue_code(&self, now: MonoNs) -> String {
        let bytes: [u8; CODE_BYTES] = rand::rng().random();
        let code = hex(&bytes, "");
        let mut codes = self.codes(now);
        if codes.len() >= CODES_MAX {
            codes.remove(0);
        }
        codes.push((code.clone(), now));
        code
    }

    /// Returns whether a code is valid, and makes it invalid, because a code works only once.
    pub fn redeem(&self, code: &str, now: MonoNs) -> bool {
        let mut codes = self.codes(now);
        let known = codes.iter().position(|(other, _)| bool::from(other.as_bytes().ct_eq(code.as_bytes())));
        known.map(|index| codes.remove(index)).is_some()
    }

    /// Addresses for phones. If the service listens on one address, this is the only one. If it listens on all addresses, the
    /// result is those in `of_machine` that phones can use.
    fn addresses(&self, of_machine: &[IpAddr]) -> Vec<SocketAddr> {
        let own = self.address;
        if !own.ip().is_unspecified() {
            return vec![own];
        }
        let is_served = |ip: &&IpAddr| match ip {
            IpAddr::V4(_) => true,
            // A link-local address needs the name of the phone's interface, which browsers do not accept.
            IpAddr::V6(ip) => own.is_ipv6() && !ip.is_unicast_link_local(),
        };
        of_machine.iter().filter(is_served).map(|ip| SocketAddr::new(*ip, own.port())).collect()
    }

    /// Returns links with a new code. On failure, returns the status code and the reason.
    fn reply(&self, now: MonoNs) -> Result<PairReply, (StatusCode, String)> {
        let addresses = self.addresses(&machine_addresses());
        if addresses.is_empty() {
            let error = "this machine has no network address; connect it to the network of the phone";
            return Err((StatusCode::CONFLICT, error.into()));
        }
        let code = self.issue_code(now);
        let links = addresses.iter().map(|address| link(address, &code)).collect::<Result<_, _>>()?;
        let fingerprint = self.fingerprint.to_string();
        Ok(PairReply { links, valid_s: VALID.as_secs(), fingerprint })
    }
}

/// Returns the link to an address with this code, also as a QR code. A failure is an internal error, because it does not
/// depend on the state of the service.
fn link(address: impl Display, code: &str) -> Result<PairingLink, (StatusCode, String)> {
    let address = format!("https://{address}");
    let url = format!("{address}/?pair={code}");
    let svg = QrCode::new(&url).map_err(|error| {
        let error = format!("cannot make a QR code: {error}");
        (StatusCode::INTERNAL_SERVER_ERROR, error)
    })?;
    let svg = svg.render::<svg::Color<'_>>().min_dimensions(240, 240).build();
    Ok(PairingLink { address, url, svg })
}

/// Addresses of the network interfaces that are up, without loopback.
fn machine_addresses() -> Vec<IpAddr> {
    let Ok(interfaces) = getifaddrs() else { return Vec::new() };
    let is_up = |flags: InterfaceFlags| {
        flags.contains(InterfaceFlags::IFF_UP) && !flags.contains(InterfaceFlags::IFF_LOOPBACK)
    };
    let address = |address: SockaddrStorage| match (address.as_sockaddr_in(), address.as_sockaddr_in6()) {
        (Some(known), _) => Some(IpAddr::V4(known.ip())),
        (None, Some(known)) => Some(IpAddr::V6(known.ip())),
        (None, None) => None,
    };
    interfaces
        .filter(|interface| is_up(interface.flags))
        .filter_map(|interface| interface.address.and_then(address))
        .collect()
}

pub(super) async fn pair(
    State(ApiState { service, pairing, .. }): State<ApiState>,
    JsonBody(PairRequest {}): JsonBody<PairRequest>,
) -> Result<Json<PairReply>, Response> {
    let Some(pairing) = pairing else {
        return Err(refusal(
            StatusCode::CONFLICT,
            "phones have no access to this service; start it with `--listen ADDRESS:PORT`, such as --listen 0.0.0.0:7312",
        ));
    };
    pairing.reply(service.now()).map(Json).map_err(|(status, error)| refusal(status, &error))
}

#[cfg(test)]
mod tests {
    use shared::time::NS_PER_S;

    use super::*;

    #[test]
    fn a_code_is_redeemed_once_within_five_minutes_and_only_the_latest_are_kept() {
        let now = MonoNs(0);
        let pairing =
            Pairing::new(([127, 0, 0, 1], 7312).into(), Fingerprint::from_certificate(b"certificate"));
        let PairReply { links, .. } = pairing.reply(now).unwrap();
        let [PairingLink { address, url, svg }] = &links[..] else { panic!("{links:?}") };
        let code = url.strip_prefix("https://127.0.0.1:7312/?pair=").unwrap();
        assert!(address == "https://127.0.0.1:7312" && svg.contains("<svg"), "{links:?}");
        assert!(!pairing.redeem("", now) && !pairing.redeem(&code[1..], now));
        assert!(pairing.redeem(code, now) && !pairing.redeem(code, now));
        let codes: Vec<_> = (0..=CODES_MAX).map(|_| pairing.issue_code(now)).collect();
        let redeem = |code: &String| pairing.redeem(code, now);
        assert!(!redeem(&codes[0]) && codes[1..].iter().all(redeem));
        let after_s = |seconds: i64| now.plus_ns(seconds * NS_PER_S);
        let [first, second] = [0, 1].map(|seconds| pairing.issue_code(after_s(seconds)));
        assert!(!pairing.redeem(&first, after_s(300)) && pairing.redeem(&second, after_s(300)));
    }

    #[test]
    fn a_service_on_all_addresses_has_links_to_those_of_its_families() {
        let of_machine = ["192.0.2.1", "2001:db8::1", "fe80::1"].map(|ip| ip.parse::<IpAddr>().unwrap());
        let links = |listen: &str| {
            let pairing =
                Pairing::new(listen.parse().unwrap(), Fingerprint::from_certificate(b"certificate"));
            pairing.addresses(&of_machine).iter().map(SocketAddr::to_string).collect::<Vec<_>>()
        };
        assert_eq!(links("0.0.0.0:7312"), ["192.0.2.1:7312"]);
        assert_eq!(links("[::]:7312"), ["192.0.2.1:7312", "[2001:db8::1]:7312"]);
        assert_eq!(links("127.0.0.1:7312"), ["127.0.0.1:7312"]);
    }

    #[test]
    fn a_qr_code_that_cannot_be_made_is_an_error_of_the_service() {
        let (status, error) = link("x".repeat(3000), "code").unwrap_err();
        assert_eq!(status, StatusCode::INTERNAL_SERVER_ERROR, "{error}");
    }
}
