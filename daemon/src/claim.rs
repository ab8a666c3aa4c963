//! Who has an interface or a directory: one process at a time, and whoever comes second is told which and what it does.
//!
//! A claim is a listening socket in the kernel's abstract namespace. It needs no file that every user may write, ends
//! with its process however that ends, and lets others ask the holder. It reaches as far as interface names do: the
//! network namespace. It is advisory: a MainDevice of another make knows nothing of it. A lock on a file would need a
//! directory that every user may write, and could not state what its holder does now.

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

/// How long a holder may take to say what it does.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// Longest answer that is listened to \[bytes\].
const ANSWER_BYTES_MAX: u64 = 300;
/// A holder that ends while it is asked leaves the claim to who asked.
const ATTEMPTS: usize = 3;

static DOING: Mutex<String> = Mutex::new(String::new());

/// What others are told that this process does: "records run `x`".
pub fn tell(doing: impl Into<String>) {
    *DOING.lock().unwrap_or_else(PoisonError::into_inner) = doing.into();
}

fn doing() -> String {
    let doing = DOING.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let command = std::env::args().nth(1).unwrap_or_default();
    format!("`ballbard {command}`, {}", if doing.is_empty() { "between runs" } else { &doing })
}

/// Who has what was claimed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holder {
    /// Process; none where it is in another container.
    pub pid: Option<i32>,
    /// Its user, if that is another one than this process has: every user of the machine can hold a name.
    pub user: Option<String>,
    /// What it says of itself.
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

/// Holds something for this process until it is dropped.
#[derive(Debug)]
pub struct Claim {
    listener: Arc<UnixListener>,
    answering: Option<thread::JoinHandle<()>>,
}

impl Claim {
    /// Claims a network interface; none where the system has no such claims, which the log says.
    pub fn interface(name: &str) -> Result<Option<Self>, Holder> {
        Self::take(&format!("ballbard/interface/{name}"))
    }

    /// Claims a directory that is there, by whichever path.
    pub fn directory(disk: &dyn Disk, path: &Path) -> Result<Option<Self>, Holder> {
        match disk.id_at(path) {
            Ok(id) => Self::take(&format!("ballbard/directory/{id}")),
            Err(error) => Ok(unclaimed(&path.display().to_string(), &error)),
        }
    }

    fn take(name: &str) -> Result<Option<Self>, Holder> {
        let mut problem = ErrorKind::AddrInUse.into();
        for _ in 0..ATTEMPTS {
            problem = match Self::listen(name) {
                Ok(claim) => return Ok(Some(claim)),
                Err(error) => error,
            };
            if let Ok(holder) = ask(name) {
                return Err(holder);
            }
        }
        Ok(unclaimed(name, &problem))
    }

    fn listen(name: &str) -> io::Result<Self> {
        Self::hold(UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)?)
    }

    fn hold(listener: UnixListener) -> io::Result<Self> {
        let listener = Arc::new(listener);
        let asked = Arc::clone(&listener);
        let answer = move || {
            while let Ok((mut stream, _)) = asked.accept() {
                // It fits into any socket's buffer; whoever asked may have gone.
                let _ = stream.write_all(doing().as_bytes());
            }
        };
        let answering = thread::Builder::new().name("claim".into()).spawn(answer)?;
        Ok(Self { listener, answering: Some(answering) })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Wakes the thread that answers; the name is free when it has let go of the socket.
        let _ = shutdown(self.listener.as_raw_fd(), Shutdown::Both);
        if let Some(answering) = self.answering.take() {
            let _ = answering.join();
        }
    }
}

fn unclaimed(name: &str, error: &io::Error) -> Option<Claim> {
    tracing::warn!("{name} cannot be claimed: {error}; take care that nobody else uses it");
    None
}

fn ask(name: &str) -> io::Result<Holder> {
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

fn name_of(user: Uid) -> String {
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
        // On most file systems it gets the same number.
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
    fn one_has_it_at_a_time_and_the_others_get_to_know_who() {
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
