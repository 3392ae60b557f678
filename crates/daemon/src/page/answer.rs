//! Answers of the API: JSON, and an error with its text.

use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::shown::ShownError;
use super::window::NoFrame;

/// Why a request was not answered as asked: `{"error": ".."}`.
#[derive(Debug)]
pub(crate) struct Failure {
    code: StatusCode,
    text: String,
}

#[derive(Serialize)]
struct FailureJson<'a> {
    error: &'a str,
}

impl Failure {
    pub(crate) fn new(code: StatusCode, text: impl Into<String>) -> Self {
        Self { code, text: text.into() }
    }

    /// The request itself is wrong.
    pub(crate) fn wrong(text: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, text)
    }

    /// It cannot be done as things stand.
    pub(crate) fn conflict(text: impl Into<String>) -> Self {
        Self::new(StatusCode::CONFLICT, text)
    }

    /// Nothing has come to be shown.
    pub(crate) fn no_frame() -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "no frame has been seen yet")
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        let mut response = (self.code, json(&FailureJson { error: &self.text })).into_response();
        if self.code == StatusCode::UNAUTHORIZED {
            let scheme = HeaderValue::from_static("Bearer realm=\"samsod\"");
            response.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
        }
        response
    }
}

impl From<ShownError> for Failure {
    fn from(error: ShownError) -> Self {
        let code = match error {
            ShownError::Gone => StatusCode::GONE,
            ShownError::Encode(_) => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self::new(code, error.to_string())
    }
}

impl From<NoFrame> for Failure {
    fn from(error: NoFrame) -> Self {
        match error {
            NoFrame::Gone => Self::new(StatusCode::GONE, "this frame is not kept any more; newer ones have come"),
            NoFrame::Unknown => Self::new(StatusCode::NOT_FOUND, "no frame of this number was shown"),
        }
    }
}

impl From<QueryRejection> for Failure {
    fn from(error: QueryRejection) -> Self {
        Self::wrong(error.body_text())
    }
}

/// A value as JSON.
pub(crate) fn json(value: &impl Serialize) -> Response {
    match serde_json::to_vec(value) {
        Ok(bytes) => json_bytes(bytes),
        // Numbers and texts: never seen.
        Err(e) => (StatusCode::INTERNAL_SERVER_ERROR, e.to_string()).into_response(),
    }
}

/// What is JSON already.
pub(crate) fn json_bytes(bytes: impl Into<Bytes>) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], bytes.into()).into_response()
}

/// The body of a request, whatever it says of its type.
pub(crate) fn body<T: DeserializeOwned>(bytes: &Bytes) -> Result<T, Failure> {
    serde_json::from_slice(bytes).map_err(|e| Failure::wrong(format!("the request cannot be read: {e}")))
}
