//! Destination of frames: a network interface, or the simulated segment in this process.

mod ethernet;
mod in_process;

use std::io;

use shared::time::MonoNs;

pub use ethernet::{EthernetWire, OpenError, interface_index, interfaces};
pub use in_process::InProcessWire;
pub use simulated_segment::{self as simulated, FRAME_BYTES_MAX, faults};

/// Carries Ethernet frames to a segment and back. One thread owns it.
pub trait FrameWire: Send {
    /// Hands a frame to the wire.
    fn send(&mut self, frame: &[u8]) -> io::Result<()>;

    /// Waits for the next frame until `until`; its length in `buffer`, or `None` when the time is over.
    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>>;
}
