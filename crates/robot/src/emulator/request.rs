//! What a host sends, taken apart. No I/O: bytes go in, requests come out.
//!
//! The start line and headers end at CRLF or at a lone CR; data are exactly as many bytes as the header says.

/// Greatest length of a start line or header, bytes.
pub const HEADER_MAX: usize = 256;

/// Greatest size of data that a header may announce, bytes.
pub const DATA_MAX: usize = 4096;

/// Part of a conversation, as it comes in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Incoming {
    /// The start line.
    Start {
        /// Commands to serve on this connection; -1 for no limit.
        keep_alive: i32,
    },
    /// A header.
    Header {
        /// Name of the command.
        command: String,
        /// Bytes of data that follow.
        size: usize,
    },
    /// The data that a header has announced.
    Data(Vec<u8>),
}

/// Why bytes are no request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum IncomingError {
    /// Not `CONNECT Robot_access`, or a keep-alive that is neither -1 nor 2 to 32767.
    #[error("{line:?} is no start line")]
    StartLine {
        /// What came.
        line: String,
    },
    /// Not `HOSTCTRL_REQUEST <COMMAND> <SIZE>`.
    #[error("{line:?} is no header")]
    Header {
        /// What came.
        line: String,
    },
    /// A line without an end, or one with bytes that are no printable ASCII.
    #[error("a line of more than {HEADER_MAX} bytes, or of bytes that are no printable ASCII")]
    NoLine,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Expects {
    Start,
    Header,
    Data(usize),
}

/// Takes requests out of a stream of bytes.
#[derive(Debug, Clone)]
pub struct RequestParser {
    expects: Expects,
    bytes: Vec<u8>,
    after_cr: bool,
    failed: Option<IncomingError>,
}

impl Default for RequestParser {
    fn default() -> Self {
        Self { expects: Expects::Start, bytes: Vec::new(), after_cr: false, failed: None }
    }
}

impl RequestParser {
    /// A parser that waits for the start line.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next bytes, and appends what they complete.
    ///
    /// # Errors
    /// [`IncomingError`]; what came before it has been appended, and every later call fails alike.
    pub fn feed(&mut self, bytes: &[u8], incoming: &mut Vec<Incoming>) -> Result<(), IncomingError> {
        if let Some(error) = &self.failed {
            return Err(error.clone());
        }
        for &byte in bytes {
            match self.take(byte) {
                Ok(Some(part)) => incoming.push(part),
                Ok(None) => {}
                Err(error) => {
                    self.failed = Some(error.clone());
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    fn take(&mut self, byte: u8) -> Result<Option<Incoming>, IncomingError> {
        let after_cr = std::mem::replace(&mut self.after_cr, byte == b'\r');
        if byte == b'\n' && after_cr && self.bytes.is_empty() {
            return Ok(None);
        }
        if let Expects::Data(size) = self.expects {
            self.bytes.push(byte);
            if self.bytes.len() < size {
                return Ok(None);
            }
            self.expects = Expects::Header;
            return Ok(Some(Incoming::Data(std::mem::take(&mut self.bytes))));
        }
        match byte {
            b'\r' => self.line().map(Some),
            b' '..=b'~' if self.bytes.len() < HEADER_MAX => {
                self.bytes.push(byte);
                Ok(None)
            }
            _ => Err(IncomingError::NoLine),
        }
    }

    fn line(&mut self) -> Result<Incoming, IncomingError> {
        // Only printable ASCII gets here.
        let line = String::from_utf8_lossy(&std::mem::take(&mut self.bytes)).into_owned();
        let fields: Vec<&str> = line.split_whitespace().collect();
        if self.expects == Expects::Start {
            let keep_alive = match fields[..] {
                // Without a number of commands one is served.
                ["CONNECT", "Robot_access"] => Some(1),
                ["CONNECT", "Robot_access", keep_alive] => keep_alive
                    .strip_prefix("Keep-Alive:")
                    .and_then(|n| n.parse::<i32>().ok())
                    .filter(|n| *n == -1 || (2..=32767).contains(n)),
                _ => None,
            };
            self.expects = Expects::Header;
            return keep_alive
                .map(|keep_alive| Incoming::Start { keep_alive })
                .ok_or(IncomingError::StartLine { line });
        }
        let ["HOSTCTRL_REQUEST", command, size] = fields[..] else {
            return Err(IncomingError::Header { line });
        };
        match size.parse::<usize>() {
            Ok(size) if size <= DATA_MAX => {
                self.expects = if size > 0 { Expects::Data(size) } else { Expects::Header };
                Ok(Incoming::Header { command: command.to_string(), size })
            }
            _ => Err(IncomingError::Header { line }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn incoming(bytes: &[u8]) -> Result<Vec<Incoming>, IncomingError> {
        let (mut parser, mut parts) = (RequestParser::new(), Vec::new());
        parser.feed(bytes, &mut parts).map(|()| parts)
    }

    #[test]
    fn lines_end_at_crlf_or_cr_and_data_where_the_header_says() {
        let streams = [
            &b"CONNECT Robot_access Keep-Alive:-1\r\nHOSTCTRL_REQUEST HOLD 2\r\n1\rHOSTCTRL_REQUEST RSTATS 0\r\n"[..],
            b"CONNECT Robot_access Keep-Alive:-1\rHOSTCTRL_REQUEST HOLD 2\r1\rHOSTCTRL_REQUEST RSTATS 0\r",
            // An end of the data that the size does not count.
            b"CONNECT Robot_access Keep-Alive:-1\r\nHOSTCTRL_REQUEST HOLD 2\r\n1\r\nHOSTCTRL_REQUEST RSTATS 0\r\n",
        ];
        let parts = vec![
            Incoming::Start { keep_alive: -1 },
            Incoming::Header { command: "HOLD".into(), size: 2 },
            Incoming::Data(b"1\r".to_vec()),
            Incoming::Header { command: "RSTATS".into(), size: 0 },
        ];
        for stream in streams {
            assert_eq!(incoming(stream), Ok(parts.clone()), "{}", String::from_utf8_lossy(stream));
        }
    }

    #[test]
    fn what_is_no_request_is_named() {
        let start = "CONNECT Robot_access\r";
        assert_eq!(incoming(start.as_bytes()), Ok(vec![Incoming::Start { keep_alive: 1 }]));
        for line in ["GET / HTTP/1.1", "CONNECT Robot_access Keep-Alive:1", "CONNECT Robot_access Keep-Alive:x", ""] {
            let error = incoming(format!("{line}\r").as_bytes());
            assert_eq!(error, Err(IncomingError::StartLine { line: line.into() }));
        }
        for line in ["HOSTCTRL_REQUEST RSTATS", "HOSTCTRL_REQUEST RSTATS -1", "RSTATS 0", "HOSTCTRL_REQUEST X 99999"] {
            let error = incoming(format!("{start}{line}\r").as_bytes());
            assert_eq!(error, Err(IncomingError::Header { line: line.into() }));
        }
        assert_eq!(incoming(&[b'C'; HEADER_MAX + 1]), Err(IncomingError::NoLine));
        assert_eq!(incoming(b"CONN\xff"), Err(IncomingError::NoLine));
    }
}
