//! Frames: the publishing client and the subscribing daemon.
//!
//! Input of a publisher: pixels, written into shared memory where the subscriber reads them. Output of a subscriber:
//! the latest [`Frame`], checked, with the number of frames lost before it. Sending and receiving cost constant
//! time, whatever the size of a frame.

use std::fmt;
use std::mem::MaybeUninit;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut_uninit::SampleMutUninit;

use crate::service::{Ipc, Topic, TopicLimits};
use crate::{
    CameraId, FrameError, FrameHeader, FrameLayout, FrameServiceConfig, PixelFormat, ReceiveError, RgbView, SendError,
    ServiceError, unix_time_ns,
};

fn open(config: &FrameServiceConfig) -> Result<Topic<FrameHeader>, ServiceError> {
    Topic::open(config, "frames", &TopicLimits { buffer: config.buffer_frames, borrowed: config.borrowed_frames })
}

/// Sends frames to the daemon of a cell.
///
/// A subscriber maps the memory of a new publisher when it wakes for its first frame: dropping the publisher right
/// after that frame may take the frame with it.
///
/// ```no_run
/// use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat};
/// let mut publisher = FramePublisher::open(&FrameServiceConfig::for_cell("demo"), CameraId::new("left")?)?;
/// let mut loan = publisher.loan(640, 480, PixelFormat::Rgb8)?;
/// loan.pixels().fill(128); // a camera would write here
/// loan.send()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct FramePublisher {
    // Ports before the topic: they are dropped in this order.
    port: Publisher<Ipc, [u8], FrameHeader>,
    notifier: Notifier<Ipc>,
    topic: Topic<FrameHeader>,
    camera: CameraId,
    max_frame_bytes: usize,
    next_sequence: u64,
}

impl FramePublisher {
    /// Joins a cell as a publisher of frames.
    ///
    /// # Errors
    /// [`ServiceError`], e.g. when two publishers are there already.
    pub fn open(config: &FrameServiceConfig, camera: CameraId) -> Result<Self, ServiceError> {
        Self::open_with_slots(config, camera, 1)
    }

    /// As [`FramePublisher::open`], for clients that hold `slots` of memory at a time, 1 to 64: so many more are reserved.
    ///
    /// # Errors
    /// As [`FramePublisher::open`]; [`ServiceError::Setting`] for another number of slots.
    pub fn open_with_slots(config: &FrameServiceConfig, camera: CameraId, slots: usize) -> Result<Self, ServiceError> {
        if !(1..=64).contains(&slots) {
            return Err(ServiceError::Setting { key: "slots", value: slots, min: 1, max: 64 });
        }
        let topic = open(config)?;
        let port = topic.publisher(config.max_frame_bytes, slots)?;
        let notifier = topic.notifier()?;
        Ok(Self { port, notifier, topic, camera, max_frame_bytes: config.max_frame_bytes, next_sequence: 0 })
    }

    /// How many subscribers there are now.
    pub fn subscribers(&self) -> usize {
        self.topic.messages.dynamic_config().number_of_subscribers()
    }

    /// Frames sent so far; the number of the next one.
    pub fn sent(&self) -> u64 {
        self.next_sequence
    }

    /// Numbers the frames to come from `sequence` on: for clients that pass on frames which are numbered already. The daemon takes a
    /// number that is not above the last one for a fault of the client.
    pub fn number_from(&mut self, sequence: u64) {
        self.next_sequence = sequence;
    }

    /// Borrows a slot of shared memory for a frame of packed rows.
    ///
    /// # Errors
    /// [`SendError::Frame`] for a size that no subscriber would accept, [`SendError::TooLarge`] for one above
    /// `max_frame_bytes`.
    pub fn loan(&mut self, width: u32, height: u32, format: PixelFormat) -> Result<FrameLoan<'_>, SendError> {
        let stride = u64::from(width) * format.bytes_per_pixel() as u64;
        self.loan_with_stride(width, height, format, u32::try_from(stride).unwrap_or(u32::MAX))
    }

    /// As [`FramePublisher::loan`], for rows that start `stride` bytes apart; the last one is padded, too.
    ///
    /// # Errors
    /// As [`FramePublisher::loan`].
    pub fn loan_with_stride(
        &mut self,
        width: u32,
        height: u32,
        format: PixelFormat,
        stride: u32,
    ) -> Result<FrameLoan<'_>, SendError> {
        let header = FrameHeader {
            width,
            height,
            stride,
            pixel_format: format as u32,
            camera: self.camera,
            ..Default::default()
        };
        let layout = FrameLayout::check(&header, usize::MAX)?;
        self.loan_raw(header, layout.stride() * layout.height() as usize)
    }

    /// Takes a slot of `len` bytes that may be filled by others meanwhile, and sent later with [`FramePublisher::send_slot`]: the
    /// memory into which a camera's driver writes.
    ///
    /// # Errors
    /// [`SendError::TooLarge`] for more than `max_frame_bytes`; [`SendError::Transport`] when all slots are out.
    pub fn take_slot(&mut self, len: usize) -> Result<FrameSlot, SendError> {
        self.check_len(len)?;
        let sample = self.port.loan_slice_uninit(len).map_err(|e| self.topic.send_error(e))?;
        Ok(FrameSlot { sample, len })
    }

    /// Sends a slot of this publisher under `header`. `sequence` and `camera`, and `timestamp_ns` where it is 0, are filled in.
    ///
    /// # Returns
    /// To how many subscribers it went.
    ///
    /// # Errors
    /// [`SendError::Frame`] when the header does not fit the slot, [`SendError::ForeignSlot`], [`SendError::Transport`].
    pub fn send_slot(&mut self, slot: FrameSlot, header: FrameHeader) -> Result<usize, SendError> {
        if slot.sample.header().publisher_id() != self.port.id() {
            return Err(SendError::ForeignSlot);
        }
        let header = FrameHeader { camera: self.camera, ..header };
        FrameLayout::check(&header, slot.len())?;
        FrameLoan { sample: slot.sample, header, publisher: self }.send()
    }

    fn check_len(&self, len: usize) -> Result<(), SendError> {
        if len > self.max_frame_bytes {
            return Err(SendError::TooLarge { bytes: len, max: self.max_frame_bytes, key: "max_frame_bytes" });
        }
        Ok(())
    }

    /// Borrows a slot of `len` bytes under a header that is not checked: for clients that pass on frames they do not
    /// look into. `sequence`, and `timestamp_ns` where it is 0, are filled in on sending.
    ///
    /// # Errors
    /// [`SendError::TooLarge`] for more than `max_frame_bytes`.
    pub fn loan_raw(&mut self, header: FrameHeader, len: usize) -> Result<FrameLoan<'_>, SendError> {
        self.check_len(len)?;
        let sample = self.port.loan_slice_uninit(len).map_err(|e| self.topic.send_error(e))?;
        Ok(FrameLoan { sample, header, publisher: self })
    }
}

/// A slot of shared memory that its holder has to itself until it is sent. Dropping it returns it unsent. It may be dropped after
/// its publisher, and on any thread.
pub struct FrameSlot {
    sample: SampleMutUninit<Ipc, [MaybeUninit<u8>], FrameHeader>,
    len: usize,
}

const _: () = {
    const fn may_move_to_another_thread<T: Send>() {}
    may_move_to_another_thread::<FrameSlot>();
};

impl FrameSlot {
    /// Its size, bytes.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Where its bytes lie, for code in other languages. The address stays the same while the slot moves, until the slot is sent
    /// or dropped. The bytes hold what an earlier frame left there.
    pub fn as_mut_ptr(&mut self) -> *mut u8 {
        self.sample.payload_mut().as_mut_ptr().cast()
    }

    /// Its bytes, which hold what an earlier frame left there until they are written. Nobody else may write to them meanwhile.
    pub fn bytes(&mut self) -> &mut [u8] {
        initialised(self.sample.payload_mut())
    }
}

impl fmt::Debug for FrameSlot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FrameSlot").field("len", &self.len()).finish_non_exhaustive()
    }
}

/// A slot of shared memory that waits for its pixels. Dropping it returns the slot unsent.
pub struct FrameLoan<'a> {
    sample: SampleMutUninit<Ipc, [MaybeUninit<u8>], FrameHeader>,
    header: FrameHeader,
    publisher: &'a mut FramePublisher,
}

impl FrameLoan<'_> {
    /// The bytes of the frame, `stride * height`. They hold what an earlier frame left there: write all of them.
    pub fn pixels(&mut self) -> &mut [u8] {
        initialised(self.sample.payload_mut())
    }

    /// Sets the time of the frame, ns since the Unix epoch, instead of the time of sending.
    pub fn set_timestamp_ns(&mut self, timestamp_ns: u64) {
        self.header.timestamp_ns = timestamp_ns;
    }

    /// Sets what the camera itself says of the frame: its number, and the time on its own clock, ns; 0 for what it does not say.
    pub fn set_camera_frame(&mut self, camera_frame: u64, camera_time_ns: u64) {
        self.header.camera_frame = camera_frame;
        self.header.camera_time_ns = camera_time_ns;
    }

    /// Sends the frame and wakes the subscribers.
    ///
    /// # Returns
    /// To how many subscribers it went.
    ///
    /// # Errors
    /// [`SendError::Transport`].
    pub fn send(self) -> Result<usize, SendError> {
        let Self { mut sample, mut header, publisher } = self;
        header.sequence = publisher.next_sequence;
        if header.timestamp_ns == 0 {
            header.timestamp_ns = unix_time_ns();
        }
        *sample.user_header_mut() = header;
        // SAFETY: as in `initialised`: every byte of the slot is initialised.
        let sample = unsafe { sample.assume_init() };
        let recipients = sample.send().map_err(|e| publisher.topic.send_error(e))?;
        publisher.next_sequence += 1;
        publisher.notifier.notify().map_err(|e| publisher.topic.send_error(e))?;
        Ok(recipients)
    }
}

impl fmt::Debug for FrameLoan<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FrameLoan").field("header", &self.header).finish_non_exhaustive()
    }
}

/// The bytes of a slot of this crate's publishers.
fn initialised(slot: &mut [MaybeUninit<u8>]) -> &mut [u8] {
    // SAFETY: the slot lies in shared memory that the system handed out zeroed and that only frames were written
    // to, so every byte of it is initialised; any byte is a valid u8, and MaybeUninit<u8> has the layout of u8.
    // The exclusive borrow of `slot` covers the returned slice.
    unsafe { &mut *(std::ptr::from_mut(slot) as *mut [u8]) }
}

/// Tells one publisher from another; a restarted client is another publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PublisherId(u128);

impl fmt::Display for PublisherId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

/// What a subscriber has seen so far, in frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FrameCounts {
    /// Handed to the caller.
    pub received: u64,
    /// Overwritten or passed over because a newer one was there.
    pub dropped: u64,
    /// Not accepted because of their header.
    pub rejected: u64,
    /// Publishers that frames came from.
    pub publishers: u64,
}

/// Receives the frames of a cell, the latest first.
#[derive(Debug)]
pub struct FrameSubscriber {
    port: Subscriber<Ipc, [u8], FrameHeader>,
    listener: Listener<Ipc>,
    topic: Topic<FrameHeader>,
    tracker: SequenceTracker,
    /// Who sent the last frame that was handed out.
    current: Option<PublisherId>,
    counts: FrameCounts,
}

impl FrameSubscriber {
    /// Joins a cell as a subscriber of its frames.
    ///
    /// # Errors
    /// [`ServiceError`], e.g. when all places are taken.
    pub fn open(config: &FrameServiceConfig) -> Result<Self, ServiceError> {
        let topic = open(config)?;
        // Frames that an earlier publisher sent before this moment are not ours to miss.
        let mut tracker = SequenceTracker::default();
        topic.messages.dynamic_config().list_publishers(|publisher| {
            tracker.join_late(PublisherId(publisher.publisher_id.value()));
            CallbackProgression::Continue
        });
        let listener = topic.listener()?;
        let port = topic.subscriber()?;
        Ok(Self { port, listener, topic, tracker, current: None, counts: FrameCounts::default() })
    }

    /// Waits for a frame, asleep until one is sent, at most for `timeout`.
    ///
    /// When several frames wait, the latest with a good header is returned; the other good ones count as dropped.
    ///
    /// # Returns
    /// `None` when no frame came in time, or when a signal woke the thread earlier.
    ///
    /// # Errors
    /// [`ReceiveError::Rejected`] when no frame with a good header was there, but one with a wrong header; after it the
    /// next may be waited for. [`FrameCounts::rejected`] counts all of these.
    /// [`ReceiveError::TooManyHeld`], [`ReceiveError::Transport`].
    pub fn wait(&mut self, timeout: Duration) -> Result<Option<Frame>, ReceiveError> {
        let deadline = Instant::now().checked_add(timeout);
        let mut slept = false;
        loop {
            if let Some(mut frame) = self.latest()? {
                frame.was_waiting = !slept;
                return Ok(Some(frame));
            }
            slept = true;
            if !self.topic.sleep(&self.listener, deadline)? {
                return Ok(None);
            }
        }
    }

    /// What this subscriber has seen so far.
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    fn latest(&mut self) -> Result<Option<Frame>, ReceiveError> {
        let mut latest: Option<Frame> = None;
        let mut rejected = None;
        loop {
            let waiting = self.port.has_samples().map_err(|e| self.topic.receive_error(e.into()))?;
            if !waiting {
                break;
            }
            let mut received = self.port.receive();
            if matches!(received, Err(iceoryx2::port::ReceiveError::ExceedsMaxBorrows)) && latest.take().is_some() {
                // The caller holds all slots but one: the older frame goes back before the newer is taken.
                self.counts.dropped = self.counts.dropped.saturating_add(1);
                received = self.port.receive();
            }
            let Some(sample) = received.map_err(|e| self.topic.receive_error(e))? else { break };
            let received_ns = unix_time_ns();
            let publisher = PublisherId(sample.origin().value());
            // The header is copied before it is checked, so that it cannot change between check and use.
            let header = *sample.user_header();
            let seen = self.tracker.see(publisher, header.sequence);
            self.counts.dropped = self.counts.dropped.saturating_add(seen.missed);
            self.counts.publishers += u64::from(seen.new_publisher);
            match FrameLayout::check(&header, sample.payload().len()) {
                Ok(layout) => {
                    let (new_publisher, was_waiting) = (self.current != Some(publisher), false);
                    let frame = Frame { sample, header, layout, publisher, new_publisher, was_waiting, received_ns };
                    if latest.replace(frame).is_some() {
                        self.counts.dropped = self.counts.dropped.saturating_add(1);
                    }
                }
                Err(source) => {
                    self.counts.rejected += 1;
                    rejected = Some(ReceiveError::Rejected { sequence: header.sequence, source });
                }
            }
        }
        match (latest, rejected) {
            (Some(frame), _) => {
                self.counts.received += 1;
                self.current = Some(frame.publisher);
                Ok(Some(frame))
            }
            (None, Some(error)) => Err(error),
            (None, None) => Ok(None),
        }
    }
}

/// A frame in shared memory. Its slot is free again when it is dropped.
#[derive(Debug)]
pub struct Frame {
    sample: Sample<Ipc, [u8], FrameHeader>,
    header: FrameHeader,
    layout: FrameLayout,
    publisher: PublisherId,
    new_publisher: bool,
    was_waiting: bool,
    received_ns: u64,
}

impl Frame {
    /// The header; its fields agree with the payload.
    pub fn header(&self) -> &FrameHeader {
        &self.header
    }

    /// Size, stride and format.
    pub fn layout(&self) -> &FrameLayout {
        &self.layout
    }

    /// Number of the frame, counted by its publisher.
    pub fn sequence(&self) -> u64 {
        self.header.sequence
    }

    /// When the client handed the frame over or its first byte came from the camera, ns since the Unix epoch.
    pub fn timestamp_ns(&self) -> u64 {
        self.header.timestamp_ns
    }

    /// Name of the camera, empty where the client gave none.
    pub fn camera(&self) -> &str {
        self.header.camera.text().unwrap_or_default()
    }

    /// Who sent it.
    pub fn publisher(&self) -> PublisherId {
        self.publisher
    }

    /// Whether the frame handed out before, if any, came from another publisher: the client was started or exchanged.
    pub fn is_from_new_publisher(&self) -> bool {
        self.new_publisher
    }

    /// Whether the frame lay there already when it was asked for: its latency is then not that of the transport but of
    /// a subscriber that was busy.
    pub fn was_waiting(&self) -> bool {
        self.was_waiting
    }

    /// When the frame was in hand here, ns since the Unix epoch.
    pub fn received_ns(&self) -> u64 {
        self.received_ns
    }

    /// Time from the client's timestamp to the frame in hand; `None` for a timestamp in the future.
    pub fn latency(&self) -> Option<Duration> {
        self.received_ns.checked_sub(self.header.timestamp_ns).map(Duration::from_nanos)
    }

    /// The payload as it was sent; it starts at a multiple of 8 bytes.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }

    /// The frame as packed RGB: where it lies if it is packed rgb8, else converted into `scratch`.
    ///
    /// # Errors
    /// [`FrameError::Payload`], which the checks on receipt rule out.
    pub fn rgb<'a>(&'a self, scratch: &'a mut Vec<u8>) -> Result<RgbView<'a>, FrameError> {
        let len = self.bytes().len();
        self.layout.rgb(self.bytes(), scratch).ok_or(FrameError::Payload {
            len,
            needed: self.layout.payload_bytes(),
            width: self.layout.width(),
            height: self.layout.height(),
            stride: self.layout.stride(),
            format: self.layout.format(),
        })
    }
}

/// Counts what is missing in the sequences of the last few publishers.
#[derive(Debug, Default)]
struct SequenceTracker {
    /// Publisher, the next number expected of it (`None`: any), whether a frame of it was seen. Latest last.
    publishers: Vec<(PublisherId, Option<u64>, bool)>,
}

/// What a sequence number says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Seen {
    missed: u64,
    new_publisher: bool,
}

impl SequenceTracker {
    /// More than take part at a time, so that one in service is never forgotten.
    const REMEMBERED: usize = 8;
    /// A larger jump is a client that set its count anew, not a loss.
    const LARGEST_GAP: u64 = u32::MAX as u64;

    fn join_late(&mut self, publisher: PublisherId) {
        self.publishers.push((publisher, None, false));
    }

    fn see(&mut self, publisher: PublisherId, sequence: u64) -> Seen {
        let known = self.publishers.iter().position(|(id, ..)| *id == publisher);
        let (expected, seen) = known.map_or((Some(0), false), |i| {
            let (_, expected, seen) = self.publishers.remove(i);
            (expected, seen)
        });
        if self.publishers.len() >= Self::REMEMBERED {
            self.publishers.remove(0);
        }
        self.publishers.push((publisher, Some(sequence.wrapping_add(1)), true));
        let gap = expected.and_then(|e| sequence.checked_sub(e)).filter(|&gap| gap <= Self::LARGEST_GAP);
        Seen { missed: gap.unwrap_or(0), new_publisher: !seen }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: PublisherId = PublisherId(1);
    const B: PublisherId = PublisherId(2);

    fn missed(tracker: &mut SequenceTracker, publisher: PublisherId, sequence: u64) -> u64 {
        tracker.see(publisher, sequence).missed
    }

    #[test]
    fn gaps_are_counted_per_publisher() {
        let mut t = SequenceTracker::default();
        assert_eq!(t.see(A, 0), Seen { missed: 0, new_publisher: true });
        assert_eq!(t.see(A, 1), Seen { missed: 0, new_publisher: false });
        assert_eq!(missed(&mut t, A, 5), 3);
        // B takes over, its first three frames were overwritten before we looked; A's last one comes late.
        assert_eq!(t.see(B, 3), Seen { missed: 3, new_publisher: true });
        assert_eq!(t.see(A, 6), Seen { missed: 0, new_publisher: false });
        assert_eq!(missed(&mut t, B, 4), 0);
    }

    #[test]
    fn what_was_sent_before_we_came_is_not_missed() {
        let mut t = SequenceTracker::default();
        t.join_late(A);
        assert_eq!(t.see(A, 1000), Seen { missed: 0, new_publisher: true });
        assert_eq!(missed(&mut t, A, 1002), 1);
    }

    #[test]
    fn a_count_set_anew_is_not_a_loss() {
        let mut t = SequenceTracker::default();
        missed(&mut t, A, 0);
        assert_eq!(missed(&mut t, A, u64::MAX), 0);
        assert_eq!(missed(&mut t, A, 0), 0);
        assert_eq!(missed(&mut t, A, 2), 1);
        assert_eq!(missed(&mut t, A, 1), 0);
    }

    #[test]
    fn publishers_long_gone_are_forgotten() {
        let mut t = SequenceTracker::default();
        for id in 0..1000 {
            t.see(PublisherId(id), 0);
        }
        assert_eq!(t.publishers.len(), SequenceTracker::REMEMBERED);
    }
}
