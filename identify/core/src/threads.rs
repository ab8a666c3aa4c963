//! Work on several threads, with a result that does not depend on how many.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Rows that one thread takes at once: about a millisecond of work on each of a log's.
const ROWS_AT_ONCE: usize = 256;

/// Threads that this machine runs side by side. The answer takes reading files: a tenth of a millisecond.
pub(crate) fn threads_there() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// What `work` makes of 0 to `count`, in that order. Each is long.
pub(crate) fn each<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let threads = if count > 1 { threads_there().min(count) } else { 1 };
    on_threads(threads, count, |number| Ok::<_, Infallible>(work(number))).unwrap_or_default()
}

/// What `of` makes of 0 to `count`, in that order. Each is short.
pub(crate) fn rows<T: Send>(count: usize, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let part = |part: usize| -> Vec<T> {
        (part * ROWS_AT_ONCE..count.min((part + 1) * ROWS_AT_ONCE)).map(&of).collect()
    };
    each(count.div_ceil(ROWS_AT_ONCE), part).into_iter().flatten().collect()
}

/// What both give, the first on a thread of its own.
pub fn both<A: Send, B>(aside: impl FnOnce() -> A + Send, here: impl FnOnce() -> B) -> (A, B) {
    std::thread::scope(|scope| {
        let aside = scope.spawn(aside);
        let here = here();
        (aside.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), here)
    })
}

/// What `work` makes of 0 to `count`, in that order, on so many threads, this one among them. Work is begun in its order and
/// ended once begun: of several errors the first one in that order is always found.
///
/// # Errors
/// That of `work`.
pub(crate) fn on_threads<T: Send, E: Send>(
    threads: usize,
    count: usize,
    work: impl Fn(usize) -> Result<T, E> + Sync,
) -> Result<Vec<T>, E> {
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
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
