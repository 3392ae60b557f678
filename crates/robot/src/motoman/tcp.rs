//! The TCP skin of a [`Session`]: reads and writes with deadlines, and records every byte before it leaves.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use super::command::Encoded;
use super::config::MotomanConfig;
use super::session::{Answer, BreakCause, Broken, Known, Phase, Session, State, Step};
use crate::{ConnectError, WireLog};

/// A connection that has been greeted.
pub(crate) struct Link {
    stream: TcpStream,
    session: Session,
    origin: Instant,
}

impl Link {
    /// Connects and exchanges the greeting.
    pub(crate) fn open(config: &MotomanConfig, log: &mut dyn WireLog) -> Result<Self, ConnectError> {
        let address = config.host_and_port();
        let stream = connect(&address, Duration::from_millis(config.connect_timeout_ms))?;
        let mut link = Self { stream, session: Session::new(config.session_options()), origin: Instant::now() };
        let start_line = link.session.opened(link.now());
        let greeted = link.send(&start_line, log).and_then(|()| link.step(log));
        match greeted {
            Ok(_) => Ok(link),
            Err(Broken { cause, .. }) => Err(match cause {
                BreakCause::Timeout { allowed_ms } => ConnectError::Timeout { address, timeout_ms: allowed_ms },
                BreakCause::Unexpected { reply, .. } => ConnectError::WrongGreeting { address, answer: reply },
                BreakCause::NotGood { message } => {
                    ConnectError::WrongGreeting { address, answer: format!("NG: {message}") }
                }
                BreakCause::NoReply(error) => ConnectError::WrongGreeting { address, answer: error.to_string() },
                cause => ConnectError::Unreachable { address, cause: cause.to_string() },
            }),
        }
    }

    /// Whether the connection can take another command; `false` too after the last that it was to serve.
    pub(crate) fn is_open(&self) -> bool {
        self.session.state() == State::Idle
    }

    /// Whether it ended as agreed.
    pub(crate) fn is_spent(&self) -> bool {
        self.session.state() == State::Disconnected
    }

    /// One command and its answer.
    pub(crate) fn exchange(&mut self, command: Encoded, log: &mut dyn WireLog) -> Result<Answer, Broken> {
        self.check_silence(log)?;
        let header = self.session.begin(command, self.now())?;
        self.send(&header, log)?;
        loop {
            match self.step(log)? {
                Step::Send(data) => self.send(&data, log)?,
                Step::Answered(answer) => return Ok(answer),
                Step::Greeted { .. } => {}
            }
        }
    }

    /// Takes what has come since the last answer. An LF that belongs to it is well; anything else is found by
    /// [`Session::begin`], before a byte of the next command has left.
    fn check_silence(&mut self, log: &mut dyn WireLog) -> Result<(), Broken> {
        let mut buffer = [0; 4096];
        let set = |stream: &TcpStream, on| stream.set_nonblocking(on);
        set(&self.stream, true).map_err(|e| self.failed(&e))?;
        let read = self.stream.read(&mut buffer);
        set(&self.stream, false).map_err(|e| self.failed(&e))?;
        match read {
            Ok(0) => Err(self.session.closed()),
            Ok(count) => {
                log.received(&buffer[..count]);
                self.session.received(&buffer[..count], self.now()).map(|_| ())
            }
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(()),
            Err(e) => Err(self.failed(&e)),
        }
    }

    /// Sends bytes that the session gave. They are recorded first: when that fails, they do not leave.
    fn send(&mut self, bytes: &[u8], log: &mut dyn WireLog) -> Result<(), Broken> {
        if let Err(cause) = log.sending(bytes) {
            return Err(self.session.broken(BreakCause::NotRecorded { cause }));
        }
        let mut rest = bytes;
        while !rest.is_empty() {
            let Some(remaining) = self.remaining() else {
                return Err(self.session.timed_out());
            };
            self.stream.set_write_timeout(Some(remaining)).map_err(|e| self.failed(&e))?;
            // From here on some of it may be on its way, whatever the system says.
            self.session.leaving();
            match self.stream.write(rest) {
                Ok(0) => return Err(self.session.closed()),
                Ok(count) => rest = &rest[count..],
                Err(e) if again(&e) => {}
                Err(e) => return Err(self.failed(&e)),
            }
        }
        Ok(())
    }

    /// Reads until the session has a next step.
    fn step(&mut self, log: &mut dyn WireLog) -> Result<Step, Broken> {
        let mut buffer = [0; 4096];
        loop {
            let Some(remaining) = self.remaining() else {
                return Err(self.session.timed_out());
            };
            self.stream.set_read_timeout(Some(remaining)).map_err(|e| self.failed(&e))?;
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(self.session.closed()),
                Ok(count) => {
                    log.received(&buffer[..count]);
                    if let Some(step) = self.session.received(&buffer[..count], self.now())? {
                        return Ok(step);
                    }
                }
                Err(e) if again(&e) => {}
                Err(e) => return Err(self.failed(&e)),
            }
        }
    }

    fn failed(&mut self, error: &std::io::Error) -> Broken {
        self.session.broken(BreakCause::Io { cause: error.to_string() })
    }

    fn now(&self) -> Duration {
        self.origin.elapsed()
    }

    /// Time to the deadline of the session; `None` when it has passed. Never zero: the system would wait without end.
    fn remaining(&self) -> Option<Duration> {
        let deadline = self.session.deadline()?;
        deadline.checked_sub(self.now()).filter(|left| !left.is_zero()).map(|left| left.max(Duration::from_millis(1)))
    }
}

fn again(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

fn connect(address: &str, timeout: Duration) -> Result<TcpStream, ConnectError> {
    let unreachable = |cause: String| ConnectError::Unreachable { address: address.to_string(), cause };
    let mut cause = "the name has no address".to_string();
    for socket_address in address.to_socket_addrs().map_err(|e| unreachable(e.to_string()))? {
        match TcpStream::connect_timeout(&socket_address, timeout) {
            Ok(stream) => {
                // Every line is an exchange: waiting for more to send would only slow it down.
                stream.set_nodelay(true).map_err(|e| unreachable(e.to_string()))?;
                return Ok(stream);
            }
            Err(error) => cause = error.to_string(),
        }
    }
    Err(unreachable(cause))
}

/// An exchange without a connection.
pub(crate) fn not_open() -> Broken {
    Broken { phase: Phase::Idle, known: Known::NotExecuted, cause: BreakCause::NotOpen }
}
