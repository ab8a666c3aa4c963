//! Exclusive claims of network interfaces and of directories with recordings. While one process holds a claim, other
//! processes cannot get it. The refusal names the holder and what the holder is doing.
//!
//! A claim is a listening socket in the abstract namespace of the kernel. The kernel closes the socket
//! when the process of the holder ends, even by a crash. Another process can connect to the socket and
//! query the holder. A claim is valid within one network namespace, like the names of interfaces. Claims
//! are advisory: other programs that operate an EtherCAT bus do not check them.
//!
//! A lock file was not chosen, because it would need a directory that every user may write, and could
//! not report the activity of the holder.

use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsRawFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use nix::sys::socket::{Shutdown, getsockopt, shutdown, sockopt::PeerCredentials};
use nix::unistd::{Uid, User, geteuid};
use shared::recording::Disk;

/// Time limit for the answer of a holder.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// Length limit of an answer \[bytes\].
const ANSWER_BYTES_MAX: u64 = 300;
/// Number of attempts to claim. Several are needed, because a holder may end while it is queried.
const ATTEMPTS: usize = 3;

/// What this process is doing. Empty between runs.
static ACTIVITY: Mutex<String> = Mutex::new(String::new());

/// Sets the activity of this process that other processes can query, such as "recording run `x`".
pub fn set_activity(activity: impl Into<String>) {
    *ACTIVITY.lock().unwrap_or_else(PoisonError::into_inner) = activity.into();
}

/// The answer of this process to a query.
fn own_activity() -> String {
    let activity = ACTIVITY.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let command = std::env::args().nth(1).unwrap_or_default();
    format!("`ballbard {command}`, {}", if activity.is_empty() { "between runs" } else { &activity })
}

/// The process that has claimed something.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holder {
    /// Process id; `None` if the process is in another container.
    pub pid: Option<i32>,
    /// User of the process, if it is not the user of this process. The user matters because every user
    /// of the machine can claim a name.
    pub user: Option<String>,
    /// Command and activity of the process.
    pub doing: String,
}

impl fmt::Display for Holder {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.pid {
            Some(pid) => write!(formatter, "process {pid}")?,
            None => write!(formatter, "a process of another container")?,
        }
        if let Some(user) = &self.user {
            write!(formatter, " of user {user}")?;
        }
        write!(formatter, " ({})", self.doing)
    }
}

/// A claim that this process holds until the value is dropped.
#[derive(Debug)]
pub struct Claim {
    listener: Arc<UnixListener>,
    answering: Option<thread::JoinHandle<()>>,
}

impl Claim {
    /// Claims a network interface. Returns `None` and logs a warning if the system does not support claims.
    pub fn interface(name: &str) -> Result<Option<Self>, Holder> {
        Self::claim_name(&format!("ballbard/interface/{name}"))
    }

    /// Claims an existing directory. The claim is for the directory itself, whatever path leads to it.
    pub fn directory(disk: &dyn Disk, path: &Path) -> Result<Option<Self>, Holder> {
        match disk.id_at(path) {
            Ok(id) => Self::claim_name(&format!("ballbard/directory/{id}")),
            Err(error) => Ok(unclaimed(&path.display().to_string(), &error)),
        }
    }

    fn claim_name(name: &str) -> Result<Option<Self>, Holder> {
        let mut listen_error = ErrorKind::AddrInUse.into();
        for _ in 0..ATTEMPTS {
            listen_error = match Self::listen(name) {
                Ok(claim) => return Ok(Some(claim)),
                Err(error) => error,
            };
            if let Ok(holder) = query_holder(name) {
                return Err(holder);
            }
        }
        Ok(unclaimed(name, &listen_error))
    }

    fn listen(name: &str) -> io::Result<Self> {
        let listener = Arc::new(UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)?);
        let queried = Arc::clone(&listener);
        let answer = move || {
            while let Ok((mut stream, _)) = queried.accept() {
                // The answer is short enough for the buffer of any socket, so writing does not block. The error is ignored,
                // because the client may have disconnected.
                let _ = stream.write_all(own_activity().as_bytes());
            }
        };
        let answering = thread::Builder::new().name("claim".into()).spawn(answer)?;
        Ok(Self { listener, answering: Some(answering) })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // The shutdown wakes the answering thread. The name is free when that thread has closed the
        // socket, so wait for the thread.
        let _ = shutdown(self.listener.as_raw_fd(), Shutdown::Both);
        if let Some(answering) = self.answering.take() {
            let _ = answering.join();
        }
    }
}

fn unclaimed(name: &str, error: &io::Error) -> Option<Claim> {
    tracing::warn!("{name} cannot be claimed: {error}; make sure that no other program uses it");
    None
}

fn query_holder(name: &str) -> io::Result<Holder> {
    let stream = UnixStream::connect_addr(&SocketAddr::from_abstract_name(name)?)?;
    stream.set_read_timeout(Some(ANSWER_TIMEOUT))?;
    let peer = getsockopt(&stream, PeerCredentials).ok();
    let pid = peer.map(|peer| peer.pid()).filter(|pid| *pid > 0);
    let user = peer.map(|peer| Uid::from_raw(peer.uid())).filter(|user| *user != geteuid()).map(name_of);
    let mut answer = Vec::new();
    let answered = stream.take(ANSWER_BYTES_MAX).read_to_end(&mut answer);
    let doing = match answered {
        Ok(_) if !answer.is_empty() => String::from_utf8_lossy(&answer).replace(char::is_control, " "),
        _ => "it does not answer".into(),
    };
    Ok(Holder { pid, user, doing })
}

/// Name of a user account, or its number if it has no name.
pub(crate) fn name_of(user: Uid) -> String {
    User::from_uid(user).ok().flatten().map_or_else(|| user.to_string(), |known| known.name)
}

#[cfg(test)]
mod tests {
    use shared::recording::SystemDisk;

    use super::*;

    #[test]
    fn a_directory_that_is_made_after_a_claimed_one_was_removed_is_free() {
        let home = tempfile::tempdir().unwrap();
        let (first, second) = (home.path().join("first"), home.path().join("second"));
        std::fs::create_dir(&first).unwrap();
        let _claim = Claim::directory(&SystemDisk, &first).unwrap();
        std::fs::remove_dir(&first).unwrap();
        // On most file systems the new directory gets the inode number of the removed directory.
        std::fs::create_dir(&second).unwrap();
        assert!(Claim::directory(&SystemDisk, &second).unwrap().is_some());
    }

    #[test]
    fn a_holder_of_another_user_is_named_with_that_user() {
        let mut holder = Holder { pid: Some(7), user: Some(name_of(Uid::from_raw(0))), doing: "x".into() };
        assert_eq!(holder.to_string(), "process 7 of user root (x)");
        holder.user = Some(name_of(Uid::from_raw(3_999_999_999)));
        assert_eq!(holder.to_string(), "process 7 of user 3999999999 (x)");
        holder.user = None;
        assert_eq!(holder.to_string(), "process 7 (x)");
    }

    #[test]
    fn one_process_has_it_at_a_time_and_others_learn_which() {
        let directory = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        let claim = Claim::directory(&SystemDisk, directory.path()).unwrap();
        let same = elsewhere.path().join("link");
        std::os::unix::fs::symlink(directory.path(), &same).unwrap();
        for path in [directory.path(), &same] {
            let holder = Claim::directory(&SystemDisk, path).unwrap_err();
            assert_eq!((holder.pid, holder.user), (i32::try_from(std::process::id()).ok(), None));
            assert!(holder.doing.contains("ballbard"), "{}", holder.doing);
        }
        assert!(Claim::directory(&SystemDisk, elsewhere.path()).unwrap().is_some());
        drop(claim);
        assert!(Claim::directory(&SystemDisk, &same).unwrap().is_some());
    }
}
