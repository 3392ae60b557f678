//! The conversation with a controller as a state machine. No I/O, no clock: bytes and times go in, bytes come out.
//!
//! ```text
//! Disconnected -opened-> Greeting -OK-> Idle -begin-> AwaitHeader -OK-> [data] -> AwaitAnswer -> Idle
//! NG, timeout, end of stream, bytes that do not belong -> Broken(phase)
//! ```
//!
//! One command is in flight, and every state that waits has a deadline. A broken conversation says what is
//! [known](Known) of the command that was in flight: before the last bytes of a command began to leave, it was not
//! executed; after that nobody knows. A broken session stays broken: a new connection needs a new one.

use std::time::Duration;

use super::command::{Effect, Encoded};
use super::reply::{Reply, ReplyError, ReplyParser};

/// Where in the conversation something happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The start line was sent, or is about to be.
    Greeting,
    /// Between commands.
    Idle,
    /// The header of a command was sent, or is about to be; its data was not.
    Header,
    /// The command is complete but for its answer.
    Answer,
}

/// State of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not opened yet, or ended as agreed after the last of the commands that one connection serves.
    Disconnected,
    /// Waits for the answer to the start line.
    Greeting,
    /// Takes a command.
    Idle,
    /// Waits for the answer to a header.
    AwaitHeader,
    /// Waits for the answer to a command.
    AwaitAnswer,
    /// Broken; see [`Broken`].
    Broken(Phase),
}

/// What is known of the command that was in flight when the conversation broke.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Known {
    /// The controller never had the whole of it, or it only reads: nothing was executed.
    NotExecuted,
    /// It had left, and no answer came: executed, being executed, or not.
    Unknown,
}

/// Why a conversation broke.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BreakCause {
    /// No answer in time.
    #[error("no answer within {allowed_ms} ms")]
    Timeout {
        /// Time allowed, ms.
        allowed_ms: u64,
    },
    /// The controller closed the connection.
    #[error("the controller closed the connection")]
    Closed,
    /// The controller answered NG.
    #[error("the controller answered NG: {message}")]
    NotGood {
        /// What it said.
        message: String,
    },
    /// Bytes that are no reply.
    #[error(transparent)]
    NoReply(#[from] ReplyError),
    /// A reply that has no place here.
    #[error("the controller answered {reply:?} where {expected} was due")]
    Unexpected {
        /// What came.
        reply: String,
        /// What should have come.
        expected: &'static str,
    },
    /// The operating system reported an error of the connection.
    #[error("the connection failed: {cause}")]
    Io {
        /// What it said.
        cause: String,
    },
    /// The bytes could not be recorded, so they were not sent.
    #[error("the bytes could not be recorded and were not sent: {cause}")]
    NotRecorded {
        /// What the record said.
        cause: String,
    },
    /// The session was broken before, or was never opened.
    #[error("the connection is not open")]
    NotOpen,
}

/// A conversation that broke.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{cause}")]
pub struct Broken {
    /// Where.
    pub phase: Phase,
    /// What is known of the command in flight.
    pub known: Known,
    /// Why.
    pub cause: BreakCause,
}

/// What to do next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// The controller has greeted; commands may begin.
    Greeted {
        /// What it calls itself.
        product: String,
    },
    /// Send these bytes: call [`Session::leaving`] just before.
    Send(Vec<u8>),
    /// The command has ended.
    Answered(Answer),
}

/// Answer to a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// `0000`
    Done,
    /// A data line.
    Data(String),
    /// It was refused, and so not executed.
    Refused {
        /// Interpreter message.
        code: u32,
    },
}

/// What a session has to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SessionOptions {
    /// Commands that one connection serves: -1 for no limit, or 2 to 32767.
    pub keep_alive: i32,
    /// Time for the answer to the start line.
    pub greeting_timeout: Duration,
    /// Time for the answer to a header.
    pub header_timeout: Duration,
    /// Time for the answer to a command.
    pub answer_timeout: Duration,
}

/// The state machine of one connection.
#[derive(Debug, Clone)]
pub struct Session {
    options: SessionOptions,
    state: State,
    parser: ReplyParser,
    deadline: Option<(Duration, Duration)>,
    in_flight: Option<InFlight>,
    served: i64,
    /// A reply that nobody had asked for.
    surplus: Option<Reply>,
}

#[derive(Debug, Clone)]
struct InFlight {
    name: &'static str,
    effect: Effect,
    data: Option<Vec<u8>>,
    /// The last bytes of the command have begun to leave.
    left: bool,
}

impl Session {
    /// A session that is not opened yet.
    pub fn new(options: SessionOptions) -> Self {
        Self {
            options,
            state: State::Disconnected,
            parser: ReplyParser::new(),
            deadline: None,
            in_flight: None,
            served: 0,
            surplus: None,
        }
    }

    /// State.
    pub fn state(&self) -> State {
        self.state
    }

    /// Time by which the controller must have answered, if it must.
    pub fn deadline(&self) -> Option<Duration> {
        self.deadline.map(|(at, _)| at)
    }

    /// The connection was made at `now`: gives the start line to send.
    pub fn opened(&mut self, now: Duration) -> Vec<u8> {
        self.wait(State::Greeting, now, self.options.greeting_timeout);
        format!("CONNECT Robot_access Keep-Alive:{}\r\n", self.options.keep_alive).into_bytes()
    }

    /// Begins a command at `now`: gives the header to send.
    ///
    /// # Errors
    /// [`Broken`] with [`Known::NotExecuted`] if the session is not idle, or if the controller has said what nobody
    /// asked for: then question and answer would no longer belong together.
    pub fn begin(&mut self, command: Encoded, now: Duration) -> Result<Vec<u8>, Broken> {
        if self.state != State::Idle {
            let phase = if let State::Broken(phase) = self.state { phase } else { Phase::Idle };
            return Err(Broken { phase, known: Known::NotExecuted, cause: BreakCause::NotOpen });
        }
        if let Some(reply) = self.surplus.take() {
            return Err(self.unexpected(&reply, "silence"));
        }
        if self.parser.is_within_line() {
            return Err(self.broken(BreakCause::Unexpected { reply: "part of a line".into(), expected: "silence" }));
        }
        let Encoded { name, header, data, effect } = command;
        self.in_flight = Some(InFlight { name, effect, data, left: false });
        self.wait(State::AwaitHeader, now, self.options.header_timeout);
        Ok(header)
    }

    /// The bytes that this session gave last are recorded, and are about to leave.
    pub fn leaving(&mut self) {
        let header_only = self.state == State::AwaitHeader && self.in_flight.as_ref().is_some_and(|c| c.data.is_none());
        if let Some(command) = &mut self.in_flight {
            command.left = header_only || self.state == State::AwaitAnswer;
        }
    }

    /// Bytes that have come at `now`. `None`: wait for more.
    ///
    /// # Errors
    /// [`Broken`]
    pub fn received(&mut self, bytes: &[u8], now: Duration) -> Result<Option<Step>, Broken> {
        let mut replies = Vec::new();
        let fault = self.parser.feed(bytes, &mut replies).err();
        let mut step = None;
        for reply in replies {
            match step {
                None => step = self.reply(reply, now)?,
                // Behind the answer to a header nothing may come before the data was sent.
                Some(Step::Send(_)) => return Err(self.unexpected(&reply, "silence until the data was sent")),
                // The answer stands; that more came is told when the next command is to begin.
                Some(_) => self.surplus = Some(reply),
            }
        }
        match fault {
            // What came before an answer was complete spoils it; what came behind spoils the next command.
            Some(error) if step.is_none() || matches!(step, Some(Step::Send(_))) => Err(self.broken(error.into())),
            Some(_) => {
                self.surplus = Some(Reply::Data("bytes that are no reply".into()));
                Ok(step)
            }
            None => Ok(step),
        }
    }

    /// The controller has closed the connection.
    pub fn closed(&mut self) -> Broken {
        let cause = self.parser.end().err().map_or(BreakCause::Closed, BreakCause::NoReply);
        self.broken(cause)
    }

    /// The deadline has passed.
    pub fn timed_out(&mut self) -> Broken {
        let allowed = self.deadline.map_or(Duration::ZERO, |(_, allowed)| allowed);
        self.broken(BreakCause::Timeout { allowed_ms: allowed.as_millis() as u64 })
    }

    /// The connection failed, or the bytes to be sent could not be recorded.
    pub fn broken(&mut self, cause: BreakCause) -> Broken {
        let phase = match self.state {
            State::Greeting => Phase::Greeting,
            State::Disconnected | State::Idle => Phase::Idle,
            State::AwaitHeader => Phase::Header,
            State::AwaitAnswer => Phase::Answer,
            State::Broken(phase) => phase,
        };
        let known = match self.in_flight.take() {
            Some(command) if command.left && command.effect == Effect::Acts => Known::Unknown,
            _ => Known::NotExecuted,
        };
        self.state = State::Broken(phase);
        self.deadline = None;
        Broken { phase, known, cause }
    }

    fn wait(&mut self, state: State, now: Duration, allowed: Duration) {
        self.state = state;
        self.deadline = Some((now + allowed, allowed));
    }

    fn reply(&mut self, reply: Reply, now: Duration) -> Result<Option<Step>, Broken> {
        match (self.state, reply) {
            (State::Greeting, Reply::Ok { text }) => {
                (self.state, self.deadline) = (State::Idle, None);
                Ok(Some(Step::Greeted { product: text }))
            }
            (State::Greeting | State::AwaitHeader | State::AwaitAnswer, Reply::NotGood { message }) => {
                Err(self.broken(BreakCause::NotGood { message }))
            }
            (State::AwaitHeader, Reply::Ok { text }) => self.header_accepted(&text, now),
            // Some controllers refuse at the header already; nothing was executed then either.
            (State::AwaitHeader | State::AwaitAnswer, Reply::Error { code }) => Ok(self.end(Answer::Refused { code })),
            (State::AwaitAnswer, Reply::Done) => Ok(self.end(Answer::Done)),
            (State::AwaitAnswer, Reply::Data(line)) if self.reads() => Ok(self.end(Answer::Data(line))),
            (state, reply) => {
                let expected = match state {
                    State::Greeting => "OK: to the start line",
                    State::AwaitHeader => "OK: to the header",
                    State::AwaitAnswer => "the answer to the command",
                    State::Disconnected | State::Idle | State::Broken(_) => "silence",
                };
                Err(self.unexpected(&reply, expected))
            }
        }
    }

    fn reads(&self) -> bool {
        self.in_flight.as_ref().is_some_and(|command| command.effect == Effect::Reads)
    }

    fn header_accepted(&mut self, text: &str, now: Duration) -> Result<Option<Step>, Broken> {
        let Some(command) = &mut self.in_flight else {
            return Err(self.broken(BreakCause::NotOpen));
        };
        if text != command.name {
            let reply = Reply::Ok { text: text.to_string() };
            return Err(self.unexpected(&reply, "OK: with the name of the command"));
        }
        let data = command.data.clone();
        self.wait(State::AwaitAnswer, now, self.options.answer_timeout);
        Ok(data.map(Step::Send))
    }

    fn end(&mut self, answer: Answer) -> Option<Step> {
        self.in_flight = None;
        self.deadline = None;
        self.served += 1;
        let spent = self.options.keep_alive > 0 && self.served >= i64::from(self.options.keep_alive);
        self.state = if spent { State::Disconnected } else { State::Idle };
        Some(Step::Answered(answer))
    }

    fn unexpected(&mut self, reply: &Reply, expected: &'static str) -> Broken {
        self.broken(BreakCause::Unexpected { reply: reply.to_string(), expected })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motoman::command::{Request, Terminator};

    const NOW: Duration = Duration::from_secs(1);

    fn options() -> SessionOptions {
        SessionOptions {
            keep_alive: -1,
            greeting_timeout: Duration::from_millis(100),
            header_timeout: Duration::from_millis(200),
            answer_timeout: Duration::from_millis(300),
        }
    }

    fn idle() -> Session {
        let mut session = Session::new(options());
        assert_eq!(session.opened(NOW), b"CONNECT Robot_access Keep-Alive:-1\r\n");
        session.leaving();
        let step = session.received(b"OK: DX Information Server(1.0) Keep-Alive:-1.\r\n", NOW).unwrap();
        assert!(matches!(step, Some(Step::Greeted { product }) if product.starts_with("DX ")));
        session
    }

    fn encoded(request: &Request) -> Encoded {
        request.encode(Terminator::Cr).unwrap()
    }

    /// A session that has sent the header of HOLD.
    fn holding() -> Session {
        let mut session = idle();
        session.begin(encoded(&Request::Hold { on: true }), NOW).unwrap();
        session.leaving();
        session
    }

    #[test]
    fn a_command_goes_header_data_answer_each_with_its_deadline() {
        let mut session = holding();
        assert_eq!((session.state(), session.deadline()), (State::AwaitHeader, Some(Duration::from_millis(1200))));
        assert_eq!(session.received(b"OK: HO", NOW), Ok(None));
        let later = NOW * 2;
        assert_eq!(session.received(b"LD\r", later), Ok(Some(Step::Send(b"1\r".to_vec()))));
        assert_eq!((session.state(), session.deadline()), (State::AwaitAnswer, Some(Duration::from_millis(2300))));
        session.leaving();
        assert_eq!(session.received(b"\n0000\r\n", later), Ok(Some(Step::Answered(Answer::Done))));
        assert_eq!((session.state(), session.deadline()), (State::Idle, None));
    }

    #[test]
    fn header_and_answer_in_one_segment_are_two_replies() {
        let mut session = idle();
        session.begin(encoded(&Request::ReadStatus), NOW).unwrap();
        session.leaving();
        let step = session.received(b"OK:RSTATS\r194,64\r", NOW).unwrap();
        assert_eq!(step, Some(Step::Answered(Answer::Data("194,64".into()))));
    }

    #[test]
    fn before_the_data_leaves_nothing_was_executed_and_after_that_nobody_knows() {
        let mut session = holding();
        let broken = session.timed_out();
        assert_eq!((broken.phase, broken.known), (Phase::Header, Known::NotExecuted));
        assert_eq!(broken.cause, BreakCause::Timeout { allowed_ms: 200 });

        let mut session = holding();
        session.received(b"OK: HOLD\r\n", NOW).unwrap();
        let broken = session.broken(BreakCause::NotRecorded { cause: "disk full".into() });
        assert_eq!((broken.phase, broken.known), (Phase::Answer, Known::NotExecuted), "it never left");

        let mut session = holding();
        session.received(b"OK: HOLD\r\n", NOW).unwrap();
        session.leaving();
        let broken = session.closed();
        assert_eq!((broken.phase, broken.known), (Phase::Answer, Known::Unknown));
        let again = session.begin(encoded(&Request::ReadStatus), NOW).unwrap_err();
        assert_eq!(again.cause, BreakCause::NotOpen, "a broken session stays broken");

        // Without data the header is the whole command.
        for (request, known) in [(Request::ResetAlarm, Known::Unknown), (Request::ReadStatus, Known::NotExecuted)] {
            let mut session = idle();
            session.begin(encoded(&request), NOW).unwrap();
            session.leaving();
            assert_eq!(session.closed().known, known, "{request:?}");
        }
    }

    #[test]
    fn a_refusal_is_an_answer_and_no_break() {
        let mut session = holding();
        let step = session.received(b"ERROR: HOLD is not successful(2100).\r\n", NOW).unwrap();
        assert_eq!(step, Some(Step::Answered(Answer::Refused { code: 2100 })));
        assert_eq!(session.state(), State::Idle);
    }

    #[test]
    fn replies_out_of_their_place_break_the_session() {
        let cases: [(&[u8], Known); 5] = [
            (b"OK: RSTATS\r\n", Known::NotExecuted),
            (b"0000\r\n", Known::NotExecuted),
            (b"NG: bad header\r\n", Known::NotExecuted),
            (b"OK: HOLD\r\n0000\r\n", Known::NotExecuted),
            (b"OK: HO\xffLD\r\n", Known::NotExecuted),
        ];
        for (bytes, known) in cases {
            let mut session = holding();
            assert_eq!(session.received(bytes, NOW).unwrap_err().known, known, "{}", String::from_utf8_lossy(bytes));
            assert!(matches!(session.state(), State::Broken(_)));
        }
        for bytes in [&b"OK: HOLD\r\n"[..], b"1,2\r", b"ERROR: HOLD\r\n", b"NG: no\r\n", b"00\x00"] {
            let mut session = holding();
            session.received(b"OK: HOLD\r\n", NOW).unwrap();
            session.leaving();
            let broken = session.received(bytes, NOW).unwrap_err();
            assert_eq!(broken.known, Known::Unknown, "{}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn more_than_was_asked_for_is_found_before_the_next_command_leaves() {
        for surplus in [&b"0000\r\n0000\r\n"[..], b"0000\r\nOK: R", b"0000\r\n\xff"] {
            let mut session = holding();
            session.received(b"OK: HOLD\r\n", NOW).unwrap();
            session.leaving();
            assert_eq!(session.received(surplus, NOW), Ok(Some(Step::Answered(Answer::Done))), "its answer stands");
            let broken = session.begin(encoded(&Request::Hold { on: false }), NOW).unwrap_err();
            assert_eq!((broken.phase, broken.known), (Phase::Idle, Known::NotExecuted), "{broken}");
        }
    }

    #[test]
    fn a_connection_that_has_served_its_commands_is_ended_and_not_broken() {
        let mut session = Session { options: SessionOptions { keep_alive: 2, ..options() }, ..idle() };
        for state in [State::Idle, State::Disconnected] {
            session.begin(encoded(&Request::ReadStatus), NOW).unwrap();
            session.received(b"OK: RSTATS\r\n194,64\r", NOW).unwrap();
            assert_eq!(session.state(), state);
        }
    }

    #[test]
    fn a_wrong_greeting_breaks_at_the_greeting() {
        for bytes in [&b"NG: HTTP Error Response\r\n"[..], b"220 ftp\r\n", b"SSH-2.0\r\n"] {
            let mut session = Session::new(options());
            session.opened(NOW);
            assert_eq!(session.received(bytes, NOW).unwrap_err().phase, Phase::Greeting);
        }
    }
}
