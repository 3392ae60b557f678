//! What a controller answers, taken apart line by line. No I/O: bytes go in, replies come out.
//!
//! A line ends at CR; one LF directly behind it is swallowed, whenever it comes. So CRLF and lone CR are both understood,
//! bytes may come one by one, and several replies in one read are several replies. Lines are printable ASCII of at most
//! [`LINE_MAX`] bytes: what is not ends the connection, for after it nobody can say where the next reply begins.

/// Greatest length of a line without its end, bytes. The longest answer, a read of 2048 inputs, has some 1000.
pub const LINE_MAX: usize = 2048;

/// One reply of a controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// `OK:`, to a start line or a header; the text behind it without spaces around it.
    Ok {
        /// What stood behind `OK:`.
        text: String,
    },
    /// `NG:`; the controller closes the connection after it.
    NotGood {
        /// What stood behind `NG:`.
        message: String,
    },
    /// `ERROR: .. (xxxx)`: the command was not executed.
    Error {
        /// Interpreter message, see [`meaning`](super::meaning).
        code: u32,
    },
    /// `0000`: the command was accepted.
    Done,
    /// Any other line: data, without spaces around it.
    Data(String),
}

/// Why bytes are no reply.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReplyError {
    /// No end of a line came in time.
    #[error("a reply of more than {limit} bytes without an end; it starts with {start:?}")]
    TooLong {
        /// Bytes that a line may have.
        limit: usize,
        /// The first bytes.
        start: String,
    },
    /// A byte that is no printable ASCII.
    #[error("byte 0x{byte:02x} in a reply, behind {before:?}; replies are printable ASCII, ended by CR or CRLF")]
    NotText {
        /// The byte.
        byte: u8,
        /// What came before it in the line, shortened.
        before: String,
    },
    /// The connection ended within a line.
    #[error("the connection ended within a reply, after {line:?}")]
    Truncated {
        /// What had come of the line, shortened.
        line: String,
    },
    /// An `ERROR:` line without a number in brackets.
    #[error("the reply {line:?} has no code in brackets")]
    NoCode {
        /// The line, shortened.
        line: String,
    },
}

/// Takes replies out of a stream of bytes.
#[derive(Debug, Clone, Default)]
pub struct ReplyParser {
    line: Vec<u8>,
    /// The last byte was a CR, so that an LF now belongs to it.
    after_cr: bool,
    failed: Option<ReplyError>,
}

impl ReplyParser {
    /// A parser at the begin of a line.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next bytes, and appends the replies that they complete.
    ///
    /// # Errors
    /// [`ReplyError`]; replies before the fault have been appended, and every later call fails alike.
    pub fn feed(&mut self, bytes: &[u8], replies: &mut Vec<Reply>) -> Result<(), ReplyError> {
        if let Some(error) = &self.failed {
            return Err(error.clone());
        }
        for &byte in bytes {
            match self.take(byte) {
                Ok(Some(reply)) => replies.push(reply),
                Ok(None) => {}
                Err(error) => {
                    self.failed = Some(error.clone());
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    /// Says that the stream has ended.
    ///
    /// # Errors
    /// [`ReplyError::Truncated`] if it did so within a line, or the fault that came before.
    pub fn end(&self) -> Result<(), ReplyError> {
        match &self.failed {
            Some(error) => Err(error.clone()),
            None if self.line.is_empty() => Ok(()),
            None => Err(ReplyError::Truncated { line: shortened(&self.line) }),
        }
    }

    /// Whether part of a line has come and its end has not.
    pub fn is_within_line(&self) -> bool {
        !self.line.is_empty()
    }

    fn take(&mut self, byte: u8) -> Result<Option<Reply>, ReplyError> {
        let after_cr = std::mem::replace(&mut self.after_cr, byte == b'\r');
        match byte {
            b'\n' if after_cr => Ok(None),
            b'\r' => {
                let reply = understand(&self.line)?;
                self.line.clear();
                Ok(Some(reply))
            }
            b' '..=b'~' if self.line.len() == LINE_MAX => {
                Err(ReplyError::TooLong { limit: LINE_MAX, start: shortened(&self.line) })
            }
            b' '..=b'~' => {
                self.line.push(byte);
                Ok(None)
            }
            _ => Err(ReplyError::NotText { byte, before: shortened(&self.line) }),
        }
    }
}

fn understand(line: &[u8]) -> Result<Reply, ReplyError> {
    // Only printable ASCII gets here.
    let text = String::from_utf8_lossy(line);
    let text = text.trim();
    if let Some(rest) = text.strip_prefix("OK:") {
        return Ok(Reply::Ok { text: rest.trim().to_string() });
    }
    if let Some(rest) = text.strip_prefix("NG:") {
        return Ok(Reply::NotGood { message: rest.trim().to_string() });
    }
    if text.starts_with("ERROR:") {
        let code = text.rfind('(').and_then(|open| {
            let digits = text.get(open + 1..)?.split(')').next()?.trim();
            digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok())?
        });
        return match code {
            Some(code) => Ok(Reply::Error { code }),
            None => Err(ReplyError::NoCode { line: shortened(line) }),
        };
    }
    if text == "0000" {
        return Ok(Reply::Done);
    }
    Ok(Reply::Data(text.to_string()))
}

/// The first bytes of what came, for a message.
pub(crate) fn shortened(bytes: &[u8]) -> String {
    const SHOWN: usize = 60;
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(SHOWN)]);
    if bytes.len() > SHOWN { format!("{text}..") } else { text.into_owned() }
}

impl std::fmt::Display for Reply {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ok { text } => write!(f, "OK: {}", shortened(text.as_bytes())),
            Self::NotGood { message } => write!(f, "NG: {}", shortened(message.as_bytes())),
            Self::Error { code } => write!(f, "ERROR ({code:04})"),
            Self::Done => write!(f, "0000"),
            Self::Data(line) => write!(f, "{}", shortened(line.as_bytes())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn replies(bytes: &[u8]) -> Result<Vec<Reply>, ReplyError> {
        let (mut parser, mut replies) = (ReplyParser::new(), Vec::new());
        parser.feed(bytes, &mut replies)?;
        parser.end()?;
        Ok(replies)
    }

    fn ok(text: &str) -> Reply {
        Reply::Ok { text: text.into() }
    }

    #[test]
    fn every_form_of_a_reply_is_told_from_the_others() {
        let cases = [
            (&b"OK: RSTATS\r\n"[..], ok("RSTATS")),
            (b"OK:RSTATS\r", ok("RSTATS")),
            (b"NG: HTTP Error Response\r\n", Reply::NotGood { message: "HTTP Error Response".into() }),
            (b"ERROR: MOVL is not successful(2010).\r\n", Reply::Error { code: 2010 }),
            (b"ERROR:(0017)\r", Reply::Error { code: 17 }),
            (b"0000\r\n", Reply::Done),
            (b"0000,1\r", Reply::Data("0000,1".into())),
            (b" 194, 64 \r", Reply::Data("194, 64".into())),
            (b"\r\n", Reply::Data(String::new())),
        ];
        for (bytes, reply) in cases {
            assert_eq!(replies(bytes), Ok(vec![reply]), "{:?}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn replies_in_one_segment_and_replies_byte_by_byte_are_the_same() {
        let stream = b"OK: DX Information Server(3.01) Keep-Alive:-1.\r\nOK: RSTATS\r194,64\r\nOK: HOLD\r\n0000\r\n";
        let whole = replies(stream).unwrap();
        assert_eq!(whole.len(), 5);
        let (mut parser, mut single) = (ReplyParser::new(), Vec::new());
        for byte in stream {
            parser.feed(&[*byte], &mut single).unwrap();
        }
        assert_eq!(single, whole);
    }

    #[test]
    fn what_is_no_reply_is_a_named_error_and_stays_one() {
        assert_eq!(replies(b"OK: RST"), Err(ReplyError::Truncated { line: "OK: RST".into() }));
        assert_eq!(replies(b"12\x80\r"), Err(ReplyError::NotText { byte: 0x80, before: "12".into() }));
        assert_eq!(replies(b"12\n"), Err(ReplyError::NotText { byte: b'\n', before: "12".into() }));
        assert_eq!(replies(b"1\r\n\n"), Err(ReplyError::NotText { byte: b'\n', before: String::new() }));
        for line in ["ERROR: MOVL is not successful.", "ERROR: (20x0).", "ERROR: ()", "ERROR: (99999999999)"] {
            let error = replies(format!("{line}\r").as_bytes());
            assert_eq!(error, Err(ReplyError::NoCode { line: line.into() }));
        }
        let mut parser = ReplyParser::new();
        let mut out = Vec::new();
        assert_eq!(parser.feed(&[b'1'; LINE_MAX], &mut out), Ok(()), "the greatest length is allowed");
        let long = parser.feed(b"1", &mut out).unwrap_err();
        assert!(matches!(long, ReplyError::TooLong { limit: LINE_MAX, .. }), "{long}");
        assert_eq!(parser.feed(b"\r0000\r\n", &mut out), Err(long), "nobody knows where the next reply begins");
        assert!(out.is_empty());
    }
}
