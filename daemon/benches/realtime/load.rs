//! A load for the machine. Its threads have ordinary priority, never pause, and end when the value is dropped.

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

/// Larger than the caches of most cores.
const MEMORY_BYTES: usize = 16 << 20;

pub struct Load {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Load {
    pub fn start(threads: usize) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let spawn = |_| {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || toil(&stop))
        };
        Self { threads: (0..threads).map(spawn).collect(), stop }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| {
            let _ = thread.join();
        });
    }
}

fn toil(stop: &AtomicBool) {
    let mut memory = vec![0u64; MEMORY_BYTES / 8];
    let mut value = 1u64;
    while !stop.load(Ordering::Relaxed) {
        for place in memory.iter_mut().step_by(8) {
            value = value.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            *place = value;
        }
        black_box(&memory);
        black_box(std::fs::read("/proc/self/stat").unwrap_or_default());
    }
}
