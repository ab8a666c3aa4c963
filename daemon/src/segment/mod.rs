//! The wire to which frames are sent: a network interface, or the simulated segment in this process.

mod ethernet;
mod in_process;

use std::io;

use shared::time::MonoNs;

pub use ethernet::{EthernetWire, OpenError, interface_index, interfaces};
pub use in_process::InProcessWire;
pub use simulated_segment::{self as simulated, FRAME_BYTES_MAX, faults};

/// Carries Ethernet frames to a segment and back. It is owned by one thread.
pub trait FrameWire: Send {
    /// Sends a frame to the segment.
    fn send(&mut self, frame: &[u8]) -> io::Result<()>;

    /// Waits for the next frame until the time `until`. Returns its length in `buffer`, or `None` if
    /// no frame arrived in time.
    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>>;
}
