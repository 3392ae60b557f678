//! The API below `/api/v1`: what is seen, how the cell is, and what the operator asks for.
//!
//! `crates/daemon/page/openapi.json` describes every answer; it is served too.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::extract::{DefaultBodyLimit, Query, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use serde_json::json;

use super::answer::{Failure, body, json as answer, json_bytes};
use super::shown::{Layer, Shown};
use super::{Shared, events, lesson, on_own_thread, verification};
use crate::control::Request;
use crate::interest::{Region, RegionError};

/// Longest body of a request, bytes; a shape has a limit of its own.
const LONGEST_BODY: usize = 64 * 1024;
/// How long the robot may take to resume or to stand.
const ROBOT_PATIENCE: Duration = Duration::from_secs(30);
/// How long `inspect` waits for a frame.
const FRAME_PATIENCE: Duration = Duration::from_secs(10);
/// Which frame a picture is of.
const FRAME: HeaderName = HeaderName::from_static("samsod-frame");

pub(crate) fn routes() -> Router<Shared> {
    Router::new()
        .route("/scene", get(scene))
        .route("/status", get(status))
        .route("/events", get(events::events))
        .route("/frame.jpg", get(frame))
        .route("/layers/partition.png", get(|shared, query| layer(Layer::Partition, shared, query)))
        .route("/layers/saliency.png", get(|shared, query| layer(Layer::Saliency, shared, query)))
        .route("/layers/shadow.png", get(|shared, query| layer(Layer::Shadow, shared, query)))
        .route("/token", post(token))
        .route("/hold", post(hold))
        .route("/resume", post(resume))
        .route("/new-jig", post(new_jig))
        .route("/inspect", post(inspect))
        .route("/region", get(region).put(put_region).delete(delete_region))
        .route("/teach/look", post(lesson::look))
        .route("/teach", post(lesson::teach))
        .route("/calibration/verify", post(verification::verify))
        .route("/openapi.json", get(openapi))
        .fallback(async || Failure::new(StatusCode::NOT_FOUND, "there is no such thing; /api/v1/openapi.json has all"))
        .layer(DefaultBodyLimit::max(LONGEST_BODY))
}

#[derive(Debug, Deserialize)]
struct FrameQuery {
    frame: Option<u64>,
}

/// The frame that is asked for, or the newest.
async fn shown(shared: &Shared, query: Result<Query<FrameQuery>, QueryRejection>) -> Result<Arc<Shown>, Failure> {
    let Query(FrameQuery { frame }) = query?;
    match frame {
        Some(number) => Ok(shared.window().frame(number)?),
        None => shared.window().current().await.ok_or_else(Failure::no_frame),
    }
}

async fn scene(
    State(shared): State<Shared>,
    query: Result<Query<FrameQuery>, QueryRejection>,
) -> Result<Response, Failure> {
    let shown = shown(&shared, query).await?;
    Ok(json_bytes(shown.json().await?))
}

async fn frame(
    State(shared): State<Shared>,
    query: Result<Query<FrameQuery>, QueryRejection>,
) -> Result<Response, Failure> {
    let shown = shown(&shared, query).await?;
    Ok(picture("image/jpeg", &shown, shown.jpeg().await?))
}

async fn layer(
    layer: Layer,
    State(shared): State<Shared>,
    query: Result<Query<FrameQuery>, QueryRejection>,
) -> Result<Response, Failure> {
    let shown = shown(&shared, query).await?;
    Ok(picture("image/png", &shown, shown.layer(layer).await?))
}

fn picture(kind: &'static str, shown: &Shown, bytes: Bytes) -> Response {
    ([(header::CONTENT_TYPE, kind.to_owned()), (FRAME, shown.frame.to_string())], bytes).into_response()
}

async fn status(State(shared): State<Shared>) -> Response {
    answer(&shared.status().status())
}

async fn openapi() -> Response {
    json_bytes(include_str!("../../page/openapi.json"))
}

/// The guard has compared the token.
async fn token() -> StatusCode {
    StatusCode::NO_CONTENT
}

async fn hold(State(shared): State<Shared>) -> Result<Response, Failure> {
    if let Ok(operator) = &shared.monitor().robot {
        // At once: what follows waits for a thread.
        operator.stop_motion();
    }
    ask(shared, Request::Hold).await
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ResumeBody {
    gripper_is_empty: bool,
}

async fn resume(State(shared): State<Shared>, bytes: Bytes) -> Result<Response, Failure> {
    let ResumeBody { gripper_is_empty } = body(&bytes)?;
    ask(shared, Request::Resume { gripper_is_empty }).await
}

async fn new_jig(State(shared): State<Shared>) -> Result<Response, Failure> {
    ask(shared, Request::NewJig).await
}

/// Asks the robot thread; answers with the status after it.
async fn ask(shared: Shared, request: Request) -> Result<Response, Failure> {
    let operator = match &shared.monitor().robot {
        Ok(operator) => operator.clone(),
        Err(reason) => return Err(Failure::conflict(format!("no robot is commanded in this cell: {reason}"))),
    };
    match on_own_thread(move || operator.ask(request, ROBOT_PATIENCE)).await? {
        Ok(_) => Ok(answer(&shared.status().status())),
        Err(reason) => Err(Failure::conflict(reason)),
    }
}

async fn inspect(State(shared): State<Shared>) -> Result<Response, Failure> {
    match shared.window().next(FRAME_PATIENCE).await {
        Some(shown) => Ok(json_bytes(shown.json().await?)),
        None => {
            let text = format!("no frame came within {} s", FRAME_PATIENCE.as_secs());
            Err(Failure::new(StatusCode::SERVICE_UNAVAILABLE, text))
        }
    }
}

async fn region(State(shared): State<Shared>) -> Response {
    answer(&json!({ "region_of_interest": shared.interest().region().as_deref() }))
}

async fn put_region(State(shared): State<Shared>, bytes: Bytes) -> Result<Response, Failure> {
    let region: Region = body(&bytes)?;
    change_region(shared, Some(region)).await
}

async fn delete_region(State(shared): State<Shared>) -> Result<Response, Failure> {
    change_region(shared, None).await
}

async fn change_region(shared: Shared, region: Option<Region>) -> Result<Response, Failure> {
    match shared.interest().set(region) {
        Ok(()) => Ok(answer(&json!({ "region_of_interest": shared.interest().region().as_deref() }))),
        Err(e @ RegionError::File { .. }) => Err(Failure::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string())),
        Err(e) => Err(Failure::wrong(e.to_string())),
    }
}
