//! What is fuzzed of a controller's replies: any bytes go in, and what must hold for all of them is asserted.
//!
//! Shared by the target of cargo-fuzz and by `crates/robot/tests/any_bytes.rs`, which needs no nightly compiler.

use std::time::Duration;

use samsod_robot::motoman::command::{
    JobReply, PlaceReply, Request, StatusBits, Terminator, read_alarm, read_bytes, read_pulses,
};
use samsod_robot::motoman::reply::{LINE_MAX, Reply, ReplyParser};
use samsod_robot::motoman::session::{Known, Session, SessionOptions, State};

/// Bytes from a controller.
pub(crate) fn reply(bytes: &[u8]) {
    let (mut whole, mut replies) = (ReplyParser::new(), Vec::new());
    let fault = whole.feed(bytes, &mut replies);
    let (mut cut, mut single) = (ReplyParser::new(), Vec::new());
    let single_fault = bytes.iter().try_for_each(|byte| cut.feed(&[*byte], &mut single));
    assert_eq!((&fault, &replies), (&single_fault, &single), "it must not matter how bytes are cut");
    assert_eq!(whole.end(), cut.end());
    for reply in &replies {
        let (Reply::Ok { text: line } | Reply::NotGood { message: line } | Reply::Data(line)) = reply else { continue };
        assert!(line.len() <= LINE_MAX && line.bytes().all(|b| matches!(b, b' '..=b'~')), "{line:?}");
        if let Ok(bits) = StatusBits::parse(line) {
            assert_eq!(StatusBits::parse(&bits.line()), Ok(bits));
        }
        if let Ok(place) = PlaceReply::parse(line) {
            assert!(place.pose.check().is_ok(), "{line:?} became {place:?}");
        }
        let _ = (read_pulses(line), read_alarm(line), JobReply::parse(line), read_bytes(line, 1));
    }
    conversation(bytes);
}

/// The same bytes to a session that has given a command: it ends in a defined state, and says `Unknown` only of what
/// has left.
fn conversation(bytes: &[u8]) {
    let second = Duration::from_secs(1);
    let options =
        SessionOptions { keep_alive: -1, greeting_timeout: second, header_timeout: second, answer_timeout: second };
    let mut session = Session::new(options);
    session.opened(Duration::ZERO);
    session.leaving();
    let greeted = session.received(b"OK: DX Information Server(4.00) Keep-Alive:-1.\r\n", Duration::ZERO);
    assert!(greeted.is_ok());
    let Ok(command) = (Request::Hold { on: true }).encode(Terminator::Cr) else { unreachable!("HOLD has no number") };
    let Ok(_header) = session.begin(command, Duration::ZERO) else { unreachable!("the session is idle") };
    session.leaving();
    let mut left = false;
    for part in bytes.chunks(7) {
        match session.received(part, Duration::ZERO) {
            Ok(Some(samsod_robot::motoman::session::Step::Send(_))) => {
                session.leaving();
                left = true;
            }
            Ok(_) if session.state() == State::Idle => return,
            Ok(_) => {}
            Err(broken) => {
                assert!(matches!(session.state(), State::Broken(_)));
                assert_eq!(broken.known == Known::Unknown, left, "{broken:?}");
                return;
            }
        }
    }
    assert!(matches!(session.state(), State::AwaitHeader | State::AwaitAnswer));
    assert!(session.deadline().is_some(), "whoever waits has a deadline");
}
