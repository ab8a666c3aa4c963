//! Runs the futures of ethercrab against a segment in virtual time. Each exchange of frames advances the clock. Waiting
//! without a frame also advances it.

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use ballbard::bus::use_clock;
use ballbard::clock::Clock;
use ballbard::segment::simulated::SimulatedSegment;
use ethercrab::{MainDevice, MainDeviceConfig, PduRx, PduStorage, PduTx, Timeouts};
use shared::time::UtcNs;

const FRAMES: usize = 16;
const FRAME_DATA: usize = PduStorage::element_size(1100);
/// Time by which the clock advances while no frame is on the wire \[ns\].
const IDLE_NS: i64 = 50_000;

thread_local! {
    /// Each test runs in its own thread and therefore has its own time.
    static CLOCK: Clock = Clock::virtual_from(UtcNs(0));
}

/// Absolute time of the simulation.
pub fn now_ns() -> i64 {
    CLOCK.with(|clock| clock.now().0)
}

/// Advances the virtual clock by this time.
pub fn pass_ns(duration_ns: i64) {
    CLOCK.with(|clock| clock.sleep_until(clock.now().plus_ns(duration_ns)));
}

/// An ethercrab MainDevice whose network interface is connected to a simulated segment.
pub struct Bench {
    pub segment: SimulatedSegment,
    pub maindevice: &'static MainDevice<'static>,
    tx: PduTx<'static>,
    rx: PduRx<'static>,
}

impl Bench {
    pub fn new(segment: SimulatedSegment) -> Self {
        CLOCK.with(use_clock);
        let storage = Box::leak(Box::new(PduStorage::<FRAMES, FRAME_DATA>::new()));
        let (tx, rx, pdu_loop) = storage.try_split().expect("a fresh storage");
        let config = MainDeviceConfig { dc_static_sync_iterations: 3000, ..MainDeviceConfig::default() };
        let maindevice = Box::leak(Box::new(MainDevice::new(pdu_loop, Timeouts::default(), config)));
        Self { segment, maindevice, tx, rx }
    }

    /// Polls a future until it is ready, and transfers the frames that it sends and receives.
    pub fn run<F: Future>(&mut self, future: F) -> F::Output {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        loop {
            if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
                return output;
            }
            if !self.carry_frames() {
                pass_ns(IDLE_NS);
            }
        }
    }

    /// Transfers all frames that ethercrab wants to send. Returns false if there was no frame to send.
    fn carry_frames(&mut self) -> bool {
        let mut carried = false;
        while let Some(frame) = self.tx.next_sendable_frame() {
            let mut sent = Vec::new();
            frame
                .send_blocking(|bytes| {
                    sent.extend_from_slice(bytes);
                    Ok(bytes.len())
                })
                .expect("a frame can be sent");
            let mut reply = [0; 1518];
            if let Some(len) = self.segment.exchange(now_ns(), &sent, &mut reply) {
                pass_ns(self.segment.round_trip_ns(len));
                self.rx.receive_frame(&reply[..len]).expect("a reply to a frame that was sent");
            }
            carried = true;
        }
        carried
    }
}
