//! The operator's page and its API.
//!
//! Input: the newest frame with its scene, which vision leaves in a [`Window`]; the health and counts of the service. Output: the
//! page, which is compiled in, JSON and pictures below `/api/v1`, events as they come; and what the operator asks for: hold,
//! resume, a region of interest, a part to learn, a board to measure. docs/page.md tells what it shows, `openapi.json` what can be
//! asked.
//!
//! ```text
//! vision -> window -> scene as JSON, JPEG, PNGs: made once, on threads that give way -> bulletin -> one event stream a viewer
//!           newest               on demand                                              newest
//! ```
//!
//! Nothing here is waited for by vision or the robot. A viewer that stops reading has no queue: it misses what it did not take.

mod answer;
mod api;
mod assets;
mod events;
mod guard;
mod lesson;
mod outline;
mod shown;
mod status;
mod token;
mod verification;
mod window;

use std::sync::{Arc, Mutex};
use std::thread;

use axum::http::StatusCode;
use axum::{Router, middleware};
use tokio::sync::{Semaphore, oneshot};
use tracing::info;

use crate::config::Config;
use crate::health::SharedMonitor;
use crate::interest::Interest;
use crate::place::Placer;
use crate::recording::Recorder;
use answer::Failure;
use events::Board;
use lesson::Looked;
use status::StatusSource;
use token::{Token, TokenError};

pub(crate) use shown::Raw;
pub(crate) use window::{Showing, Window};

/// All that the page is made of.
#[derive(Debug)]
pub(crate) struct Page {
    config: Config,
    placer: Option<Placer>,
    monitor: SharedMonitor,
    window: Arc<Window>,
    interest: Arc<Interest>,
    status: StatusSource,
    token: Token,
    board: Board,
    looked: Mutex<Option<Looked>>,
    /// Teaching and measuring take all cores for a moment: one at a time.
    work: Arc<Semaphore>,
}

impl Page {
    /// Makes the token, and says where it is.
    pub(crate) fn new(
        config: &Config,
        monitor: SharedMonitor,
        window: Arc<Window>,
        interest: Arc<Interest>,
        recorder: &Recorder,
    ) -> Result<Self, TokenError> {
        let http = config.http.clone().unwrap_or_default();
        let token = match &http.token_file {
            Some(path) => Token::read(path)?,
            None => Token::make(&config.service())?,
        };
        info!(file = %token.path().display(), "the operator's token");
        let recording = recorder.path().display().to_string();
        Ok(Self {
            // The service has read the camera file: what can be wrong with it has been told.
            placer: config.placer().ok().flatten(),
            config: config.clone(),
            status: StatusSource::new(config, Arc::clone(&monitor), Arc::clone(&interest), recording),
            monitor,
            window,
            interest,
            token,
            board: Board::new(),
            looked: Mutex::default(),
            work: Arc::new(Semaphore::new(1)),
        })
    }
}

/// What every request is answered from.
#[derive(Debug, Clone)]
pub(crate) struct Shared(Arc<Page>);

impl Shared {
    fn config(&self) -> &Config {
        &self.0.config
    }

    fn placer(&self) -> Option<&Placer> {
        self.0.placer.as_ref()
    }

    fn monitor(&self) -> &SharedMonitor {
        &self.0.monitor
    }

    fn window(&self) -> &Arc<Window> {
        &self.0.window
    }

    fn interest(&self) -> &Interest {
        &self.0.interest
    }

    fn status(&self) -> &StatusSource {
        &self.0.status
    }

    fn token(&self) -> &Token {
        &self.0.token
    }

    fn board(&self) -> &Board {
        &self.0.board
    }

    fn looked(&self) -> &Mutex<Option<Looked>> {
        &self.0.looked
    }

    fn hosts(&self) -> &[String] {
        self.0.config.http.as_ref().map_or(&[], |http| &http.hosts)
    }

    /// Does something that takes all cores for a moment, if nothing of the kind goes on.
    async fn at_work<T: Send + 'static>(
        &self,
        work: impl FnOnce(Self) -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        let Ok(turn) = Arc::clone(&self.0.work).try_acquire_owned() else {
            let text = "something else is being looked at; try again in a moment";
            return Err(Failure::new(StatusCode::SERVICE_UNAVAILABLE, text));
        };
        let shared = self.clone();
        // The turn ends with the work, also when whoever asked has gone away.
        let work = move || {
            let _turn = turn;
            work(shared)
        };
        on_own_thread(work).await?
    }
}

/// Waits for what an operator waits for: on a thread that does not give way as those of the pictures do.
async fn on_own_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Failure> {
    let failed = |cause: String| Failure::new(StatusCode::INTERNAL_SERVER_ERROR, cause);
    let (reply, answer) = oneshot::channel();
    // Whoever asked may have gone away.
    let work = move || drop(reply.send(work()));
    thread::Builder::new().name("page".to_owned()).spawn(work).map_err(|e| failed(e.to_string()))?;
    answer.await.map_err(|_| failed("it has failed; the log says why".to_owned()))
}

/// Page and API, and `more` beside them, behind the checks of every request. To be called inside the runtime: what is pushed is
/// announced by tasks of their own.
pub(crate) fn serve(page: Arc<Page>, more: Router) -> Router {
    let shared = Shared(page);
    tokio::spawn(events::announce_scenes(shared.clone()));
    tokio::spawn(events::announce_status(shared.clone()));
    let page: Router<Shared> = assets::routes().nest("/api/v1", api::routes());
    page.with_state(shared.clone()).merge(more).layer(middleware::from_fn_with_state(shared, guard::check))
}
