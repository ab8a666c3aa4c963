//! The digest that identifies a certificate.

use std::fmt;
use std::str::FromStr;

use sha2::{Digest, Sha256};

/// SHA-256 of a certificate, which people compare.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fingerprint(String);

impl Fingerprint {
    /// Digest of this certificate \[DER\].
    pub fn from_certificate(certificate: &[u8]) -> Self {
        Self(hex(&Sha256::digest(certificate), ":"))
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for Fingerprint {
    type Err = &'static str;

    /// Parses hexadecimal digits, in upper or lower case, with or without colons.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let digits = text.replace(':', "").to_ascii_lowercase();
        if digits.len() != 64 || !digits.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Err(
                "write the 64 hexadecimal digits that `ballbard status` prints on the service's machine",
            );
        }
        let pairs: Vec<_> = (0..64).step_by(2).map(|at| &digits[at..at + 2]).collect();
        Ok(Self(pairs.join(":")))
    }
}

pub(super) fn hex(bytes: &[u8], between: &str) -> String {
    let digits: Vec<_> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    digits.join(between)
}
