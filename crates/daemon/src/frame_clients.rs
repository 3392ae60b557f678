//! What numbers and times of frames say about the clients they come from: whether a frame can be believed to be as old as it says.
//!
//! In: publisher, number and time of each frame. Out: the number of the client, and a [`Doubt`] about the frame, if there is one.
//! A frame in doubt is seen and recorded as any other, but the robot is not shown it: nobody knows when it was taken. The way
//! back is the next frame without a doubt, so a clock that steps once costs one frame.

use std::fmt;
use std::time::Duration;

use samsod_frame::PublisherId;

/// Clients that are remembered: more than take part at a time.
const REMEMBERED: usize = 8;

/// Why a frame is not believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Doubt {
    /// Its time lies in the future.
    ClockAhead { ms: u64 },
    /// Its time lies before that of the frame before it.
    ClockBack { ms: u64 },
    /// It is older than what the robot may go by.
    TooOld { ms: u64, allowed_ms: u64 },
    /// Its number is not above that of the frame before it.
    Number { last: u64 },
}

impl Doubt {
    /// In two or three words, for health and log.
    pub(crate) fn state(&self) -> &'static str {
        match self {
            Self::ClockAhead { .. } => "clock ahead",
            Self::ClockBack { .. } => "clock stepped back",
            Self::TooOld { .. } => "too old",
            Self::Number { .. } => "numbers run back",
        }
    }
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ClockAhead { ms } => write!(f, "the clock of the frame client is {ms} ms ahead")?,
            Self::ClockBack { ms } => write!(f, "the clock of the frame client has stepped back by {ms} ms")?,
            Self::TooOld { ms, allowed_ms } => {
                write!(f, "the frame is {ms} ms old, [robot.limits] target_age_max_ms allows {allowed_ms}")?;
            }
            Self::Number { last } => write!(f, "its number is not above that of the frame before it, {last}")?,
        }
        f.write_str("; the robot is not shown it")
    }
}

#[derive(Debug, Clone, Copy)]
struct Client {
    publisher: PublisherId,
    /// From 1 on.
    number: u64,
    sequence: u64,
    timestamp_ns: u64,
}

/// The last clients.
#[derive(Debug, Default)]
pub(crate) struct FrameClients {
    /// The latest last.
    clients: Vec<Client>,
    numbers: u64,
}

/// What a frame says of itself.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stamp {
    pub(crate) publisher: PublisherId,
    pub(crate) sequence: u64,
    /// ns since the Unix epoch.
    pub(crate) timestamp_ns: u64,
    /// When it was in hand here, ns since the Unix epoch.
    pub(crate) received_ns: u64,
}

impl FrameClients {
    /// The number of the client, counted from 1 since the start, and a doubt about its frame.
    pub(crate) fn see(&mut self, stamp: &Stamp, oldest: Duration) -> (u64, Option<Doubt>) {
        let Stamp { publisher, sequence, timestamp_ns, received_ns } = *stamp;
        let known = self.clients.iter().position(|client| client.publisher == publisher);
        let before = known.map(|i| self.clients.remove(i));
        let number = before.map_or_else(
            || {
                self.numbers += 1;
                self.numbers
            },
            |client| client.number,
        );
        if self.clients.len() >= REMEMBERED {
            self.clients.remove(0);
        }
        self.clients.push(Client { publisher, number, sequence, timestamp_ns });
        let ms = |ns: u64| ns / 1_000_000;
        let (age_ns, allowed_ms) =
            (received_ns.saturating_sub(timestamp_ns), u64::try_from(oldest.as_millis()).unwrap_or(u64::MAX));
        let doubt = match before {
            Some(last) if sequence <= last.sequence => Some(Doubt::Number { last: last.sequence }),
            _ if timestamp_ns > received_ns => Some(Doubt::ClockAhead { ms: ms(timestamp_ns - received_ns) }),
            Some(last) if timestamp_ns < last.timestamp_ns => {
                Some(Doubt::ClockBack { ms: ms(last.timestamp_ns - timestamp_ns) })
            }
            _ if ms(age_ns) > allowed_ms => Some(Doubt::TooOld { ms: ms(age_ns), allowed_ms }),
            _ => None,
        };
        (number, doubt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, FrameSubscriber, PixelFormat};

    const SECOND: u64 = 1_000_000_000;
    const OLDEST: Duration = Duration::from_secs(10);

    /// Publishers have ids only from the transport.
    fn publishers() -> [PublisherId; 2] {
        let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").unwrap();
        let service = FrameServiceConfig {
            root_path: Some(folder.path().to_owned()),
            max_frame_bytes: 1 << 10,
            ..FrameServiceConfig::for_cell("clients")
        };
        let mut frames = FrameSubscriber::open(&service).unwrap();
        [0, 1].map(|_| {
            let mut publisher = FramePublisher::open(&service, CameraId::new("test").unwrap()).unwrap();
            publisher.loan(4, 4, PixelFormat::Rgb8).unwrap().send().unwrap();
            frames.wait(Duration::from_secs(60)).unwrap().unwrap().publisher()
        })
    }

    #[test]
    fn each_doubt_costs_its_frames_and_goes_away_with_the_next_good_one() {
        let [a, b] = publishers();
        let mut clients = FrameClients::default();
        let mut see = |publisher, sequence, taken_s: u64, received_s: u64| {
            let stamp = Stamp { publisher, sequence, timestamp_ns: taken_s * SECOND, received_ns: received_s * SECOND };
            clients.see(&stamp, OLDEST)
        };
        assert_eq!(see(a, 5, 1000, 1000), (1, None));
        assert_eq!(see(a, 6, 1001, 1001), (1, None));
        // A clock that is ahead, and comes back.
        assert_eq!(see(a, 7, 1062, 1002), (1, Some(Doubt::ClockAhead { ms: 60_000 })));
        assert_eq!(see(a, 8, 1003, 1003), (1, Some(Doubt::ClockBack { ms: 59_000 })));
        assert_eq!(see(a, 9, 1004, 1004), (1, None));
        // One that steps back by less than it would be refused for.
        assert_eq!(see(a, 10, 1000, 1005), (1, Some(Doubt::ClockBack { ms: 4000 })));
        assert_eq!(see(a, 11, 1001, 1006), (1, None));
        assert_eq!(see(a, 12, 1001, 1012), (1, Some(Doubt::TooOld { ms: 11_000, allowed_ms: 10_000 })));
        // Another client has a clock and a count of its own.
        assert_eq!(see(b, 0, 1013, 1013), (2, None));
        // Numbers that are given twice, and a count that begins anew.
        assert_eq!(see(a, 12, 1014, 1014), (1, Some(Doubt::Number { last: 12 })));
        assert_eq!(see(a, 3, 1015, 1015), (1, Some(Doubt::Number { last: 12 })));
        assert_eq!(see(a, 4, 1016, 1016), (1, None));
        assert_eq!(see(b, 1, 1016, 1017), (2, None));
    }

    #[test]
    fn every_doubt_says_what_becomes_of_the_frame() {
        let doubts = [
            Doubt::ClockAhead { ms: 1 },
            Doubt::ClockBack { ms: 1 },
            Doubt::TooOld { ms: 2, allowed_ms: 1 },
            Doubt::Number { last: 1 },
        ];
        for doubt in doubts {
            assert!(doubt.to_string().ends_with("; the robot is not shown it"), "{doubt}");
        }
    }
}
