//! The devices of the ball-bar's bus: their identities, and the layout of their process data.

pub mod el5021;

/// Vendor and product code of a device (EtherCAT SII words 8 and 10).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceKind {
    /// Name on the housing.
    pub name: &'static str,
    pub vendor_id: u32,
    pub product_code: u32,
}

impl DeviceKind {
    /// Whether a device with this identity is of this kind.
    pub const fn matches(&self, vendor_id: u32, product_code: u32) -> bool {
        self.vendor_id == vendor_id && self.product_code == product_code
    }
}

/// Beckhoff's EtherCAT vendor number.
const BECKHOFF: u32 = 2;

/// EtherCAT coupler, which has the reference clock of the bus. Its identity is from the dump of an EEPROM in ethercrab's
/// `dumps/`, read in 2026-11.
pub const EK1100: DeviceKind = DeviceKind { name: "EK1100", vendor_id: BECKHOFF, product_code: 0x044c_2c52 };

/// SinCos terminal for one encoder. Its identity is from `scripts/esi.yml` of linuxcnc-ethercat, read in 2026-11.
pub const EL5021: DeviceKind = DeviceKind { name: "EL5021", vendor_id: BECKHOFF, product_code: 0x139d_3052 };
