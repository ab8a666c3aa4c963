//! Sync managers control the access to process memory (ETG.1000.4 section 6.7). Each channel lets the master write or read
//! one area of the memory. The area is either a mailbox, which stays full until it is read, or a buffer of process data.

/// Number of channels that a chip can have.
pub const CHANNELS_MAX: usize = 8;

// Register 4, control.
const MODE_MASK: u8 = 0x03;
const MODE_MAILBOX: u8 = 0x02;
const WRITTEN_BY_MASTER: u8 = 0x04;
/// Mask of mode and direction. The other bits enable interrupts, and may have any value.
const FUNCTION_MASK: u8 = 0x0f;
// Register 5, status.
const STATUS_EVENT: u8 = 0x01;
const STATUS_FULL: u8 = 0x08;
// Register 6, activation.
const ENABLE: u8 = 0x01;
const REPEAT: u8 = 0x02;
// Register 7, control by the device (PDI).
const PDI_DISABLED: u8 = 0x01;

/// Direction of an access by the master.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
}

/// Result of the check of an access.
pub enum Permit {
    /// The bytes are not in the area of an active sync manager, so the memory is accessed directly.
    Plain,
    /// The access is refused: its direction is wrong, the mailbox is full or empty, or only some of its
    /// bytes are in the area.
    Denied,
    /// Permitted through this channel.
    Through(usize),
}

/// Effect on the device of an access through a channel. Only an access that includes the last byte of
/// the area has an effect.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Completion {
    /// The access has no effect, or its last byte is still missing.
    Nothing,
    /// A mailbox request is available.
    Request,
    /// New outputs are available.
    Outputs,
}

/// Settings of a sync manager that a device expects.
#[derive(Clone, Copy)]
pub struct ExpectedSyncManager {
    /// Address of the first byte in process memory.
    pub start: u16,
    /// Length \[bytes\].
    pub length: u16,
    pub control: u8,
}

/// Settings and state of one channel.
#[derive(Clone, Copy, Default)]
pub struct SyncManager {
    start: u16,
    length: u16,
    control: u8,
    activate: u8,
    /// Whether the mailbox contains a message that has not been read.
    full: bool,
    /// Whether the status register shows a write by the master.
    event: bool,
    /// Whether the device has switched the channel off.
    pub blocked: bool,
}

impl SyncManager {
    /// Applies the registers that a master has written.
    pub fn configure(&mut self, registers: &[u8; 8]) {
        let repeated = (registers[6] ^ self.activate) & REPEAT != 0;
        self.start = u16::from_le_bytes([registers[0], registers[1]]);
        self.length = u16::from_le_bytes([registers[2], registers[3]]);
        self.control = registers[4];
        self.activate = registers[6];
        if !self.is_enabled() {
            (self.full, self.event) = (false, false);
        } else if repeated && self.is_mailbox() && self.direction() == Access::Read {
            // The master has lost the last answer and requests it again. The answer is still in memory.
            self.full = true;
        }
    }

    /// Content of the registers 5 to 7: status, activation and device-side control.
    pub fn status(&self) -> [u8; 3] {
        let event = if self.event { STATUS_EVENT } else { 0 };
        let full = if self.full { STATUS_FULL } else { 0 };
        // The device acknowledges this request by setting its own repeat bit to the value of the master's repeat bit.
        let device_side = if self.blocked { PDI_DISABLED } else { 0 } | (self.activate & REPEAT);
        [event | full, self.activate, device_side]
    }

    /// Whether this channel has the settings that the device expects.
    pub fn matches(&self, expected: &ExpectedSyncManager) -> bool {
        self.is_enabled()
            && self.start == expected.start
            && self.length == expected.length
            && self.control & FUNCTION_MASK == expected.control & FUNCTION_MASK
    }

    /// Whether the mailbox is full.
    pub fn is_full(&self) -> bool {
        self.full
    }

    /// Marks a mailbox as full or empty. Called for the device.
    pub fn set_full(&mut self, full: bool) {
        (self.full, self.event) = (full, false);
    }

    fn is_enabled(&self) -> bool {
        self.activate & ENABLE != 0 && self.length > 0
    }

    fn is_active(&self) -> bool {
        self.is_enabled() && !self.blocked
    }

    fn is_mailbox(&self) -> bool {
        self.control & MODE_MASK == MODE_MAILBOX
    }

    fn direction(&self) -> Access {
        if self.control & WRITTEN_BY_MASTER == 0 { Access::Read } else { Access::Write }
    }

    fn end(&self) -> usize {
        usize::from(self.start) + usize::from(self.length)
    }

    fn overlaps(&self, from: usize, to: usize) -> bool {
        from < self.end() && usize::from(self.start) < to
    }

    /// Whether the channel permits an access to the bytes from `from` up to but not including `to`. An access to a mailbox
    /// must begin at its start.
    fn admits(&self, from: usize, to: usize, direction: Access) -> bool {
        let inside = usize::from(self.start) <= from && to <= self.end();
        let at_start = usize::from(self.start) == from;
        let ready = self.full == (direction == Access::Read);
        inside && direction == self.direction() && (!self.is_mailbox() || (at_start && ready))
    }

    fn complete(&mut self) -> Completion {
        self.event = self.direction() == Access::Write;
        match (self.is_mailbox(), self.direction()) {
            (true, Access::Write) => {
                self.full = true;
                Completion::Request
            }
            (true, Access::Read) => {
                self.full = false;
                Completion::Nothing
            }
            (false, Access::Write) => Completion::Outputs,
            (false, Access::Read) => Completion::Nothing,
        }
    }
}

/// Checks an access to `len` bytes at `address` against all channels.
pub fn permit(channels: &[SyncManager], address: u16, len: usize, direction: Access) -> Permit {
    let (from, to) = (usize::from(address), usize::from(address) + len);
    let touched = channels.iter().position(|channel| channel.is_active() && channel.overlaps(from, to));
    match touched {
        None => Permit::Plain,
        Some(index) if channels[index].admits(from, to, direction) => Permit::Through(index),
        Some(_) => Permit::Denied,
    }
}

/// Handles the end of a permitted access. An access that includes the last byte of the area is complete. Returns the effect
/// of the access on the device.
pub fn finish_access(channels: &mut [SyncManager], index: usize, address: u16, len: usize) -> Completion {
    match channels.get_mut(index) {
        Some(channel) if usize::from(address) + len == channel.end() => channel.complete(),
        _ => Completion::Nothing,
    }
}
