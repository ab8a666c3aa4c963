//! Runs a function for the numbers from 0 to `count` on several threads. Results are in the order of the numbers,
//! so they do not depend on the number of threads.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// A unit of work for [`rows`] is a range of this many numbers. One unit takes about a millisecond.
const ROWS_AT_ONCE: usize = 256;

/// Number of threads that this machine runs in parallel. The call takes a tenth of a millisecond because it reads files.
pub(crate) fn threads_there() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Results of `work` for each number from 0 to `count` (excluded), in order. Each thread takes one number at a time, so this
/// is for calls that take milliseconds or longer.
pub(crate) fn each<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let threads = if count > 1 { threads_there().min(count) } else { 1 };
    on_threads(threads, count, |number| Ok::<_, Infallible>(work(number))).unwrap_or_default()
}

/// Results of `of` for each number from 0 to `count` (excluded), in order. Each thread takes [`ROWS_AT_ONCE`]
/// numbers at a time, so this is for short calls.
pub(crate) fn rows<T: Send>(count: usize, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let part = |part: usize| -> Vec<T> {
        (part * ROWS_AT_ONCE..count.min((part + 1) * ROWS_AT_ONCE)).map(&of).collect()
    };
    each(count.div_ceil(ROWS_AT_ONCE), part).into_iter().flatten().collect()
}

/// Runs both functions at the same time and returns both results. `aside` runs on a new thread, `here`
/// on the calling thread.
pub fn both<A: Send, B>(aside: impl FnOnce() -> A + Send, here: impl FnOnce() -> B) -> (A, B) {
    std::thread::scope(|scope| {
        let aside = scope.spawn(aside);
        let here = here();
        (aside.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), here)
    })
}

/// Results of `work` for each number from 0 to `count` (excluded), in order. `threads` includes the calling thread.
///
/// Numbers are started in order. After an error no further number is started, but calls that are running finish. The
/// returned error is therefore always that of the lowest number that fails.
///
/// # Errors
/// The error of `work` for the lowest number that fails.
pub(crate) fn on_threads<T: Send, E: Send>(
    threads: usize,
    count: usize,
    work: impl Fn(usize) -> Result<T, E> + Sync,
) -> Result<Vec<T>, E> {
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
    // The loop of each thread: takes the next number until none is left or a call has failed.
    let share = || {
        let mut done = Vec::new();
        while !stop.load(Ordering::Relaxed) {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= count {
                break;
            }
            let result = work(number);
            stop.fetch_or(result.is_err(), Ordering::Relaxed);
            done.push((number, result));
        }
        done
    };
    let mut done = std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads).map(|_| scope.spawn(share)).collect();
        let mut done = share();
        for other in others {
            match other.join() {
                Ok(more) => done.extend(more),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        done
    });
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, result)| result).collect()
}
