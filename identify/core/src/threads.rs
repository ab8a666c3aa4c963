//! Work on several threads, with a result that does not depend on their number.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Number of rows in one unit of work: about a millisecond.
const ROWS_AT_ONCE: usize = 256;

/// Number of threads that this machine runs in parallel. The call reads files: a tenth of a millisecond.
pub(crate) fn threads_there() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Results of `work` for 0 to `count`, in order. For long work, one number at a time.
pub(crate) fn each<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let threads = if count > 1 { threads_there().min(count) } else { 1 };
    on_threads(threads, count, |number| Ok::<_, Infallible>(work(number))).unwrap_or_default()
}

/// Results of `of` for 0 to `count`, in order. For short work, [`ROWS_AT_ONCE`] numbers at a time.
pub(crate) fn rows<T: Send>(count: usize, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let part = |part: usize| -> Vec<T> {
        (part * ROWS_AT_ONCE..count.min((part + 1) * ROWS_AT_ONCE)).map(&of).collect()
    };
    each(count.div_ceil(ROWS_AT_ONCE), part).into_iter().flatten().collect()
}

/// Results of both functions; the first runs on a thread of its own.
pub fn both<A: Send, B>(aside: impl FnOnce() -> A + Send, here: impl FnOnce() -> B) -> (A, B) {
    std::thread::scope(|scope| {
        let aside = scope.spawn(aside);
        let here = here();
        (aside.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), here)
    })
}

/// Results of `work` for 0 to `count`, in order, with this number of threads including the calling one. Work starts in order
/// and is not interrupted: of several errors the first one in order is returned.
///
/// # Errors
/// The error of `work`.
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
