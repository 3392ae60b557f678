//! The operator's page, `GET /metrics` and `GET /healthz`, served by a thread of their own.
//!
//! Input: the [`Monitor`](crate::health::Monitor), the [`Metrics`](crate::metrics::Metrics) and the
//! [`Page`](crate::page::Page). Vision is never waited for: what is asked is read from counts and pulses that it leaves behind.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;
use tokio::runtime;
use tokio::sync::oneshot;
use tracing::{error, info, warn};

use crate::health::SharedMonitor;
use crate::metrics::{self, SharedMetrics};
use crate::page::{self, Page};

/// How far threads that make pictures give way to vision: steps of nice. Vision seldom has all cores for long, and they take what
/// it leaves.
const GIVES_WAY: i32 = 15;
/// One picture is made at a time.
const MOST_THREADS: usize = 2;

/// What is served.
#[derive(Debug, Clone)]
pub(crate) struct Served {
    pub(crate) monitor: SharedMonitor,
    pub(crate) metrics: SharedMetrics,
    pub(crate) page: Arc<Page>,
}

/// The server while it runs; dropping it closes every connection.
#[derive(Debug)]
pub(crate) struct HttpServer {
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl HttpServer {
    /// Takes a port that [`listen`] has opened.
    pub(crate) fn start(listener: TcpListener, served: Served) -> io::Result<Self> {
        let give_way = || {
            if let Err(error) = rustix::process::nice(GIVES_WAY) {
                warn!(%error, "the thread of a picture does not give way to vision");
            }
        };
        let mut runtime = runtime::Builder::new_current_thread();
        let runtime = runtime.enable_io().enable_time().max_blocking_threads(MOST_THREADS).on_thread_start(give_way);
        let runtime = runtime.build()?;
        let page = Arc::clone(&served.page);
        let own = Router::new().route("/metrics", get(metrics)).route("/healthz", get(health)).with_state(served);
        let (listener, router) = {
            let _inside = runtime.enter();
            (tokio::net::TcpListener::from_std(listener)?, page::serve(page, own))
        };
        let (stop, stopped) = oneshot::channel();
        let serve = move || {
            runtime.spawn(async move {
                if let Err(error) = axum::serve(listener, router).await {
                    error!(%error, "page, health and metrics are not served any more");
                }
            });
            // Ends with a message, or with the sender.
            let _ = runtime.block_on(stopped);
            runtime.shutdown_background();
        };
        let thread = thread::Builder::new().name("http".to_owned()).spawn(serve)?;
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }
}

impl Drop for HttpServer {
    fn drop(&mut self) {
        drop(self.stop.take());
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the thread of page, health and metrics panicked");
        }
    }
}

/// Opens the port: early, so that one that is taken is told before anything else is begun.
pub(crate) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    info!(address = %listener.local_addr()?, "page, health and metrics");
    Ok(listener)
}

async fn metrics(State(served): State<Served>) -> impl IntoResponse {
    match served.metrics.text() {
        Ok(text) => (StatusCode::OK, [(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text),
        Err(e) => (StatusCode::INTERNAL_SERVER_ERROR, [(header::CONTENT_TYPE, "text/plain")], e.to_string()),
    }
}

/// 200 while every part is fine, else 503; the same JSON in both cases.
async fn health(State(served): State<Served>) -> impl IntoResponse {
    let health = served.monitor.health();
    let code = if health.is_fine() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    match serde_json::to_string(&health) {
        Ok(text) => (code, [(header::CONTENT_TYPE, "application/json")], text + "\n"),
        Err(e) => (StatusCode::INTERNAL_SERVER_ERROR, [(header::CONTENT_TYPE, "text/plain")], e.to_string()),
    }
}
