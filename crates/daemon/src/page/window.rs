//! What vision leaves for those who watch: the newest frame with its scene.
//!
//! Input: frames that vision is done with. Output: numbered [`Shown`] ones, the newest and a few before it. Vision never waits
//! for a viewer. It copies the pixels of a frame only while somebody watches, every [`INTERVAL`] at most, and hands the scene on
//! as it is: it works on in another one. The frame that was not shown is kept in shared memory until the next comes, so that
//! whoever comes late sees the last one all the same.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use samsod_frame::Frame;
use tokio::sync::watch;
use tracing::warn;

use super::shown::{Layer, Raw, Shown};

/// Least time between two frames that are shown. With it a picture is drawn within a quarter of a second from its frame, and the
/// pictures of a second take 20 to 50 ms of a core: under 3 % of the chain where vision has all of two.
const INTERVAL: Duration = Duration::from_millis(200);
/// Frames whose pictures can still be asked for: a viewer at the end of a slow line asks late.
const KEPT: usize = 12;
/// How long a viewer waits for the newest frame before it gets an older one.
const PATIENCE: Duration = Duration::from_secs(2);

/// Shared by vision and those who watch.
#[derive(Debug)]
pub(crate) struct Window {
    newest: watch::Sender<Option<Arc<Shown>>>,
    /// The newest last.
    kept: Mutex<VecDeque<Arc<Shown>>>,
    watchers: AtomicUsize,
    layers: [AtomicUsize; Layer::ALL.len()],
    /// Frames that somebody has asked to be shown at once: a number that rises with every question.
    asked: AtomicU64,
    /// The frame that vision has done with last.
    done: AtomicU64,
}

/// Somebody watches as long as this lives.
#[derive(Debug)]
pub(crate) struct Watching {
    window: Arc<Window>,
    layers: Vec<Layer>,
}

impl Drop for Watching {
    fn drop(&mut self) {
        self.window.watchers.fetch_sub(1, Ordering::SeqCst);
        for &layer in &self.layers {
            self.window.layers[layer as usize].fetch_sub(1, Ordering::SeqCst);
        }
    }
}

/// Why there is no such frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NoFrame {
    /// It has not been seen yet, or was not shown to anybody.
    Unknown,
    /// It was shown and is no longer kept.
    Gone,
}

impl Window {
    pub(crate) fn new() -> Self {
        Self {
            newest: watch::Sender::new(None),
            kept: Mutex::default(),
            watchers: AtomicUsize::new(0),
            layers: Default::default(),
            asked: AtomicU64::new(0),
            done: AtomicU64::new(0),
        }
    }

    /// Watches from now on, for these layers, too.
    pub(crate) fn watch(self: &Arc<Self>, layers: Vec<Layer>) -> Watching {
        self.watchers.fetch_add(1, Ordering::SeqCst);
        for &layer in &layers {
            self.layers[layer as usize].fetch_add(1, Ordering::SeqCst);
        }
        Watching { window: Arc::clone(self), layers }
    }

    /// The layers that somebody watches.
    pub(crate) fn layers(&self) -> impl Iterator<Item = Layer> {
        Layer::ALL.into_iter().filter(|&layer| self.layers[layer as usize].load(Ordering::SeqCst) > 0)
    }

    /// What is shown from now on.
    pub(crate) fn subscribe(&self) -> watch::Receiver<Option<Arc<Shown>>> {
        self.newest.subscribe()
    }

    /// The frame that vision has done with last; none before the first.
    pub(crate) async fn current(self: &Arc<Self>) -> Option<Arc<Shown>> {
        let done = self.done.load(Ordering::SeqCst);
        if done == 0 {
            return None;
        }
        let _watching = self.watch(Vec::new());
        let mut newest = self.subscribe();
        let is_current = |shown: &Option<Arc<Shown>>| shown.as_ref().is_some_and(|shown| shown.frame >= done);
        // Too late is not wrong: it is the newest that there is, and it says which one it is.
        let _ = tokio::time::timeout(PATIENCE, newest.wait_for(is_current)).await;
        newest.borrow().clone()
    }

    /// The first frame that reaches vision from now on.
    pub(crate) async fn next(self: &Arc<Self>, patience: Duration) -> Option<Arc<Shown>> {
        let _watching = self.watch(Vec::new());
        let ticket = self.asked.fetch_add(1, Ordering::SeqCst) + 1;
        let mut newest = self.subscribe();
        let is_asked = |shown: &Option<Arc<Shown>>| shown.as_ref().is_some_and(|shown| shown.ticket >= ticket);
        let found = tokio::time::timeout(patience, newest.wait_for(is_asked)).await.ok()?.ok()?;
        found.clone()
    }

    /// A frame that was shown.
    pub(crate) fn frame(&self, number: u64) -> Result<Arc<Shown>, NoFrame> {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let found = kept.iter().find(|shown| shown.frame == number);
        let is_past = kept.front().is_some_and(|oldest| number < oldest.frame);
        found.cloned().ok_or(if is_past && number > 0 { NoFrame::Gone } else { NoFrame::Unknown })
    }

    fn show(&self, shown: Shown) -> Option<Vec<u8>> {
        let shown = Arc::new(shown);
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        // Of those before only the pictures are kept that somebody has asked for.
        let former = kept.back().and_then(|former| former.forget_pixels());
        kept.push_back(Arc::clone(&shown));
        if kept.len() > KEPT {
            kept.pop_front();
        }
        drop(kept);
        self.newest.send_replace(Some(shown));
        former
    }
}

/// The side of vision.
#[derive(Debug)]
pub(crate) struct Showing {
    window: Arc<Window>,
    /// The last frame, as long as it was not shown.
    held: Option<Held>,
    last: Option<Instant>,
    /// Served the questions up to this one.
    served: u64,
    /// Memory of a frame that is no longer shown.
    spare: Vec<u8>,
}

#[derive(Debug)]
struct Held {
    frame: Frame,
    raw: Raw,
    ticket: u64,
}

impl Showing {
    pub(crate) fn new(window: Arc<Window>) -> Self {
        Self { window, held: None, last: None, served: 0, spare: Vec::new() }
    }

    /// The last question, for [`Self::offer`] of the first frame that comes after it.
    pub(crate) fn last_question(&self) -> u64 {
        self.window.asked.load(Ordering::SeqCst)
    }

    /// The next frame has come: the one before is shown no more, if it was not.
    pub(crate) fn forget(&mut self) {
        self.held = None;
    }

    /// A frame that vision is done with. `raw` has everything but the pixels.
    pub(crate) fn offer(&mut self, frame: Frame, raw: Raw, last_question: u64) {
        self.window.done.store(raw.number, Ordering::SeqCst);
        self.held = Some(Held { frame, raw, ticket: last_question });
        self.show_if_wanted();
    }

    /// How long the next frame may be waited for: then the last one is due, if somebody watches.
    pub(crate) fn patience(&self, at_most: Duration) -> Duration {
        let is_watched = self.window.watchers.load(Ordering::SeqCst) > 0;
        match self.last.filter(|_| is_watched && self.held.is_some()) {
            Some(last) => INTERVAL.saturating_sub(last.elapsed()).min(at_most),
            None => at_most,
        }
    }

    /// Shows the last frame if it was not, and somebody has come to see it.
    pub(crate) fn show_if_wanted(&mut self) {
        let is_watched = self.window.watchers.load(Ordering::SeqCst) > 0;
        let is_due = self.last.is_none_or(|last| last.elapsed() >= INTERVAL);
        let is_asked = self.held.as_ref().is_some_and(|held| held.ticket > self.served);
        if !is_watched || !(is_due || is_asked) {
            return;
        }
        let Some(Held { frame, mut raw, ticket }) = self.held.take() else { return };
        let mut pixels = std::mem::take(&mut self.spare);
        pixels.clear();
        let mut scratch = Vec::new();
        match frame.rgb(&mut scratch) {
            Ok(image) => pixels.extend_from_slice(image.as_raw()),
            Err(error) => return warn!(%error, "a frame cannot be shown"),
        }
        drop(frame);
        raw.rgb = pixels;
        self.last = Some(Instant::now());
        self.served = ticket;
        self.spare = self.window.show(Shown::new(raw, ticket)).unwrap_or_default();
    }
}
