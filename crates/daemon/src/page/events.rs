//! `GET /api/v1/events`: scenes and status, pushed as they change.
//!
//! There is one bulletin, which holds the newest scene and the newest status; each viewer is sent what it has not had, when its
//! connection takes more. One that has stopped reading costs its connection, and the rest nothing. A scene is announced when its
//! picture is made, so that the page gets it at once.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::sse::Event;
use axum::response::{IntoResponse, Response, Sse};
use futures_util::stream;
use serde::Deserialize;
use tokio::sync::watch;
use tokio::time::interval;

use super::Shared;
use super::answer::Failure;
use super::shown::{Layer, Shown};
use super::window::Watching;

/// How often the status is looked at while somebody watches.
const STATUS_INTERVAL: Duration = Duration::from_millis(200);
/// Looks at the status between two heartbeats.
const LOOKS_PER_BEAT: u64 = 5;
/// Pages that may watch at a time.
const MOST_VIEWERS: usize = 32;

/// What is pushed.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bulletin {
    scene: Option<Arc<Shown>>,
    status: Arc<str>,
    beat: u64,
}

/// The bulletin and how many read it.
#[derive(Debug)]
pub(crate) struct Board {
    bulletin: watch::Sender<Bulletin>,
    viewers: AtomicUsize,
}

impl Board {
    pub(crate) fn new() -> Self {
        Self { bulletin: watch::Sender::new(Bulletin::default()), viewers: AtomicUsize::new(0) }
    }
}

/// Has the pictures of frames made while somebody watches, and announces them.
pub(crate) async fn announce_scenes(shared: Shared) {
    let mut newest = shared.window().subscribe();
    while newest.changed().await.is_ok() {
        let shown = newest.borrow_and_update().clone();
        let Some(shown) = shown.filter(|_| shared.board().viewers.load(Ordering::SeqCst) > 0) else { continue };
        if shown.make_all(shared.window().layers()).await.is_ok() {
            shared.board().bulletin.send_modify(|bulletin| bulletin.scene = Some(shown));
        }
    }
}

/// Announces the status when it changes, and a sign of life.
pub(crate) async fn announce_status(shared: Shared) {
    let mut ticks = interval(STATUS_INTERVAL);
    let mut looks = 0;
    loop {
        ticks.tick().await;
        if shared.board().viewers.load(Ordering::SeqCst) == 0 {
            continue;
        }
        looks += 1;
        let status = status_text(&shared);
        shared.board().bulletin.send_if_modified(|bulletin| {
            let (beats, changes) = (looks % LOOKS_PER_BEAT == 0, *bulletin.status != *status);
            bulletin.beat += u64::from(beats);
            if changes {
                bulletin.status = status.into();
            }
            beats || changes
        });
    }
}

fn status_text(shared: &Shared) -> String {
    serde_json::to_string(&shared.status().status()).unwrap_or_default()
}

#[derive(Debug, Deserialize)]
pub(crate) struct EventsQuery {
    #[serde(default)]
    layers: String,
}

impl FromStr for Layer {
    type Err = Failure;

    fn from_str(name: &str) -> Result<Self, Failure> {
        Self::ALL.into_iter().find(|layer| layer.name() == name).ok_or_else(|| {
            let allowed = Self::ALL.map(Self::name).join(", ");
            Failure::wrong(format!("layer is {name:?}; allowed: {allowed}"))
        })
    }
}

/// A viewer: what it has had, and what it is about to get.
struct Viewer {
    shared: Shared,
    bulletin: watch::Receiver<Bulletin>,
    had: Bulletin,
    waiting: VecDeque<Event>,
    _watching: Watching,
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.shared.board().viewers.fetch_sub(1, Ordering::SeqCst);
    }
}

pub(crate) async fn events(
    State(shared): State<Shared>,
    query: Result<Query<EventsQuery>, QueryRejection>,
) -> Result<Response, Failure> {
    let Query(EventsQuery { layers }) = query?;
    let layers = layers.split(',').filter(|name| !name.is_empty()).map(str::parse).collect::<Result<Vec<_>, _>>()?;
    let board = shared.board();
    if board.viewers.fetch_add(1, Ordering::SeqCst) >= MOST_VIEWERS {
        board.viewers.fetch_sub(1, Ordering::SeqCst);
        let text = format!("{MOST_VIEWERS} pages watch already; close one of them");
        return Err(Failure::new(StatusCode::SERVICE_UNAVAILABLE, text));
    }
    let mut viewer = Viewer {
        bulletin: board.bulletin.subscribe(),
        had: Bulletin::default(),
        waiting: VecDeque::new(),
        _watching: shared.window().watch(layers),
        shared: shared.clone(),
    };
    let status = status_text(&shared);
    viewer.waiting.push_back(Event::default().event("status").data(&status));
    viewer.had.status = status.into();
    let viewer = stream::unfold((viewer, 0u64), |(mut viewer, sent)| async move {
        // First the status, which is there; then the scene that is there already, also when no frame comes any more.
        if sent == 1
            && let Some(shown) = viewer.shared.window().current().await
            && shown.make_all(viewer.shared.window().layers()).await.is_ok()
        {
            viewer.send_scene(shown).await;
        }
        let event = viewer.next().await?;
        Some((Ok::<_, Infallible>(event), (viewer, sent + 1)))
    });
    Ok(Sse::new(viewer).into_response())
}

impl Viewer {
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some(event);
            }
            let now = self.bulletin.borrow_and_update().clone();
            if !now.status.is_empty() && now.status != self.had.status {
                self.waiting.push_back(Event::default().event("status").data(&*now.status));
                self.had.status = now.status;
            }
            if let Some(scene) = now.scene {
                self.send_scene(scene).await;
            }
            if now.beat != self.had.beat {
                self.had.beat = now.beat;
                self.waiting.push_back(Event::default().event("heartbeat").data(now.beat.to_string()));
            }
            if self.waiting.is_empty() {
                self.bulletin.changed().await.ok()?;
            }
        }
    }

    /// A scene that is newer than the one before.
    async fn send_scene(&mut self, shown: Arc<Shown>) {
        if self.had.scene.as_ref().is_some_and(|had| had.frame >= shown.frame) {
            return;
        }
        if let Ok(json) = shown.json().await {
            let text = String::from_utf8_lossy(&json);
            self.waiting.push_back(Event::default().event("scene").id(shown.frame.to_string()).data(text));
        }
        self.had.scene = Some(shown);
    }
}
