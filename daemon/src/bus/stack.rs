//! The EtherCAT stacks of this process.
//!
//! ethercrab borrows a frame storage for the rest of the process, so a stack cannot be freed. When a [`Bus`](super::Bus) is
//! dropped, its stack is kept for the next bus. The number of stacks is therefore the largest number of buses that existed
//! at the same time.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ethercrab::{MainDevice, MainDeviceConfig, PduRx, PduStorage, PduTx, RetryBehaviour, Timeouts};

use super::{BRING_UP_REPLY_TIMEOUT, BRING_UP_RETRIES};

const FRAMES_MAX: usize = 16;
const FRAME_DATA_BYTES: usize = PduStorage::element_size(1100);

/// Stacks that no bus uses at present.
static IDLE: Mutex<Vec<Stack>> = Mutex::new(Vec::new());

/// A frame storage with its sender, its receiver and the MainDevice that uses it.
pub(super) struct Stack {
    /// Frames that must be sent.
    pub tx: PduTx<'static>,
    pub rx: PduRx<'static>,
    pub main: &'static MainDevice<'static>,
    /// Time to wait for a reply. After this time the frame is sent again, or counts as lost.
    pub pdu_timeout: Duration,
}

impl Stack {
    /// Takes an unused stack, or creates one. The stack waits at least `reply_timeout` for a reply.
    pub fn take(reply_timeout: Duration) -> Self {
        let pdu_timeout = BRING_UP_REPLY_TIMEOUT.max(reply_timeout);
        let mut idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner);
        let fitting = idle.iter().position(|stack| stack.pdu_timeout == pdu_timeout);
        fitting.map(|index| idle.swap_remove(index)).unwrap_or_else(|| Self::new(pdu_timeout))
    }

    /// Keeps this stack for the next bus.
    pub fn leave(self) {
        IDLE.lock().unwrap_or_else(PoisonError::into_inner).push(self);
    }

    fn new(pdu_timeout: Duration) -> Self {
        let storage: &'static PduStorage<FRAMES_MAX, FRAME_DATA_BYTES> =
            Box::leak(Box::new(PduStorage::new()));
        // The storage was just created, and splitting fails only when it is repeated.
        #[allow(clippy::expect_used, reason = "the storage was made one line above")]
        let (tx, rx, pdu_loop) = storage.try_split().expect("fresh storage");
        // Frames are sent again only during the bring-up, because `Exchange::run_until` never repeats a frame. EEPROM and
        // mailbox are polled until they are ready. Their time-outs therefore include the retries of one poll.
        let repeated = pdu_timeout * (BRING_UP_RETRIES as u32 + 1);
        let usual = Timeouts::default();
        let timeouts = Timeouts {
            pdu: pdu_timeout,
            eeprom: usual.eeprom + repeated,
            mailbox_echo: usual.mailbox_echo + repeated,
            ..usual
        };
        let config = MainDeviceConfig {
            retry_behaviour: RetryBehaviour::Count(BRING_UP_RETRIES),
            ..MainDeviceConfig::default()
        };
        Self { tx, rx, main: Box::leak(Box::new(MainDevice::new(pdu_loop, timeouts, config))), pdu_timeout }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stack_that_was_left_is_used_again() {
        // Other tests may take and return stacks at the same time, but no test can take the stacks in `held`.
        let held: Vec<Stack> = (0..3).map(|_| Stack::take(Duration::ZERO)).collect();
        let places: Vec<*const MainDevice> =
            held.iter().map(|stack| std::ptr::from_ref(stack.main)).collect();
        held.into_iter().for_each(Stack::leave);
        let again: Vec<Stack> = (0..32).map(|_| Stack::take(Duration::ZERO)).collect();
        let found = again.iter().filter(|stack| places.contains(&std::ptr::from_ref(stack.main))).count();
        again.into_iter().for_each(Stack::leave);
        assert!(found >= 1, "none of three came back");
    }
}
