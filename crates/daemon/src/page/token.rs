//! The operator's token: what is needed to change something.
//!
//! Input: the file of `[http] token_file`, or nothing. Output: a token that requests are compared with. Without a file of the
//! configuration a token is made at each start, of 100 random bits, in a file beside the lock of the cell that its own user alone
//! may read. The log names the file, never the token.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use samsod_frame::FrameServiceConfig;
use sha2::{Digest, Sha256};

/// Characters of a token of the configuration.
const LENGTH: [usize; 2] = [16, 256];
/// Without those that are taken for one another.
const LETTERS: &[u8; 32] = b"abcdefghjkmnpqrstuvwxyz023456789";
/// Groups of five letters, each of five bits.
const GROUPS: usize = 4;

/// A token; what is kept is its digest.
pub(crate) struct Token {
    digest: [u8; 32],
    path: PathBuf,
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Token").field("path", &self.path).finish_non_exhaustive()
    }
}

/// Why there is none.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TokenError {
    #[error("cannot use {}: {source}", path.display())]
    File { path: PathBuf, source: io::Error },
    #[error("{} has {what}; allowed: one line of {} to {} letters, digits and signs without spaces", path.display(), LENGTH[0], LENGTH[1])]
    Text { path: PathBuf, what: String },
    #[error("{} may be read by all users; it must not: chmod o= {}", path.display(), path.display())]
    Open { path: PathBuf },
}

impl Token {
    /// Takes the token of a file.
    pub(crate) fn read(path: &Path) -> Result<Self, TokenError> {
        let fail = |source| TokenError::File { path: path.to_owned(), source };
        let file = File::open(path).map_err(fail)?;
        if file.metadata().map_err(fail)?.permissions().mode() & 0o007 != 0 {
            return Err(TokenError::Open { path: path.to_owned() });
        }
        let mut text = String::new();
        file.take(4096).read_to_string(&mut text).map_err(fail)?;
        let token = text.trim();
        let wrong = |what: String| Err(TokenError::Text { path: path.to_owned(), what });
        let [least, most] = LENGTH;
        if !token.bytes().all(|byte| byte.is_ascii_graphic()) {
            return wrong("spaces, lines or letters that a header cannot carry".to_owned());
        }
        if !(least..=most).contains(&token.len()) {
            return wrong(format!("{} characters", token.len()));
        }
        Ok(Self { digest: digest(token), path: path.to_owned() })
    }

    /// Makes one, and writes it where the lock of the cell is, which must be held.
    pub(crate) fn make(service: &FrameServiceConfig) -> Result<Self, TokenError> {
        let folder = service.root_path.as_deref().unwrap_or(Path::new("/tmp"));
        let path = folder.join(format!("samsod-{}.token", service.cell));
        let fail = |source| TokenError::File { path: path.clone(), source };
        let mut random = [0u8; 5 * GROUPS];
        File::open("/dev/urandom").and_then(|mut file| file.read_exact(&mut random)).map_err(fail)?;
        let letters: Vec<u8> = random.iter().map(|byte| LETTERS[usize::from(byte % 32)]).collect();
        let groups: Vec<_> = letters.chunks(5).map(String::from_utf8_lossy).collect();
        let token = groups.join("-");
        match fs::remove_file(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(fail(e)),
            _ => {}
        }
        // A new one: never through a link that somebody has put there.
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
        file.and_then(|mut file| writeln!(file, "{token}")).map_err(fail)?;
        Ok(Self { digest: digest(&token), path })
    }

    /// Where it can be read.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether this is the token. Digests are compared, so the time that takes tells nothing of the token.
    pub(crate) fn is(&self, token: &str) -> bool {
        digest(token) == self.digest
    }
}

fn digest(token: &str) -> [u8; 32] {
    Sha256::digest(token.as_bytes()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_that_is_made_is_for_its_user_alone_and_another_at_every_start() {
        let folder = tempfile::tempdir().unwrap();
        let service =
            FrameServiceConfig { root_path: Some(folder.path().to_owned()), ..FrameServiceConfig::for_cell("c") };
        let precious = folder.path().join("precious");
        fs::write(&precious, "text").unwrap();
        std::os::unix::fs::symlink(&precious, folder.path().join("samsod-c.token")).unwrap();
        let token = Token::make(&service).unwrap();
        assert_eq!(fs::read_to_string(&precious).unwrap(), "text", "a link is not written through");
        let text = fs::read_to_string(token.path()).unwrap();
        assert_eq!(fs::metadata(token.path()).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!((text.len(), text.matches('-').count()), (24, 3), "{text}");
        assert!(token.is(text.trim()) && !token.is(&text) && !token.is("") && !token.is(&text[..23].to_uppercase()));
        let other = Token::make(&service).unwrap();
        assert!(!other.is(text.trim()));
        assert!(!format!("{token:?}").contains(text.trim()));
    }

    #[test]
    fn a_file_that_all_may_read_or_that_holds_no_token_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let read = |text: &str, mode: u32| {
            fs::write(&path, text).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            Token::read(&path).map_err(|e| e.to_string())
        };
        assert!(read("correct-horse-battery\n", 0o640).unwrap().is("correct-horse-battery"));
        assert!(read("correct-horse-battery\n", 0o644).unwrap_err().contains("chmod o= "));
        assert!(read("short\n", 0o600).unwrap_err().contains("has 5 characters; allowed: one line of 16 to 256"));
        assert!(read("correct horse battery", 0o600).unwrap_err().contains("has spaces"));
        fs::remove_file(&path).unwrap();
        assert!(Token::read(&path).unwrap_err().to_string().contains("No such file"));
    }
}
