//! The live view: what is recorded, as it is written, for Foxglove's viewer over a WebSocket.
//!
//! The recorder's thread hands every message to it that it writes, so that topics, schemas and times are those of a
//! recording, and a layout made for one shows the other. It never waits for a viewer: each has a short queue,
//! from which the oldest fall out. A message that no viewer has subscribed to costs nothing.
//!
//! There is no token: the protocol of the viewer knows none. It is therefore off unless the section `[foxglove]` is there, and on the
//! loopback unless told otherwise. Nothing can be commanded through it.

use std::net::{Ipv4Addr, SocketAddr};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `[foxglove]`: the topics of the recording live, for Foxglove's viewer. Without the section they are not served.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FoxgloveConfig {
    /// Address and port; port 0 takes a free one, which the log tells. Whoever reaches it sees frames, scenes and commands: there is
    /// no token.
    #[schemars(with = "String")]
    pub listen: SocketAddr,
}

impl Default for FoxgloveConfig {
    fn default() -> Self {
        Self { listen: (Ipv4Addr::LOCALHOST, 8765).into() }
    }
}

/// Why there is no live view.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LiveViewError {
    /// The port cannot be had.
    #[error(
        "cannot serve the live view on {listen}: {cause}; [foxglove] listen takes a free address and port of this machine"
    )]
    Listen {
        /// Address and port.
        listen: SocketAddr,
        /// What the system said.
        cause: String,
    },
    /// This samsodd cannot.
    #[error(
        "[foxglove] listen = \"{listen}\": this samsodd is built without the feature \"live\", so it has no live view"
    )]
    NotBuilt {
        /// Address and port.
        listen: SocketAddr,
    },
}

/// What was built without the feature `live`: there is none.
#[cfg(not(feature = "live"))]
#[derive(Debug)]
pub(crate) enum LiveView {}

#[cfg(not(feature = "live"))]
impl LiveView {
    pub(crate) fn start(config: FoxgloveConfig, _: &super::RecorderConfig, _: &str) -> Result<Self, LiveViewError> {
        Err(LiveViewError::NotBuilt { listen: config.listen })
    }

    pub(super) fn send(&self, _: super::messages::Topic, _: u64, _: &[u8]) {
        match *self {}
    }
}

#[cfg(feature = "live")]
pub(crate) use server::LiveView;

#[cfg(feature = "live")]
mod server {
    use std::net::SocketAddr;
    use std::sync::{Arc, mpsc};
    use std::thread::{self, JoinHandle};

    use foxglove::{ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, WebSocketServer};
    use tokio::runtime;
    use tokio::sync::oneshot;
    use tracing::{error, info, warn};

    use super::super::messages::{Topic, descriptions};
    use super::super::{ImageEncoding, RecorderConfig};
    use super::{FoxgloveConfig, LiveViewError};

    /// Messages that wait for one viewer. A frame has some ten, of which an image may hold several MB: the memory that a viewer can
    /// take by not reading is that of three frames.
    pub(super) const BACKLOG_MESSAGES: usize = 32;

    /// The server while it runs; dropping it closes every connection.
    pub(crate) struct LiveView {
        /// In the order of [`Topic`].
        channels: Vec<Arc<RawChannel>>,
        /// The channels belong to it.
        _context: Arc<Context>,
        stop: Option<oneshot::Sender<()>>,
        thread: Option<JoinHandle<()>>,
    }

    impl std::fmt::Debug for LiveView {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            f.debug_struct("LiveView").field("channels", &self.channels.len()).finish_non_exhaustive()
        }
    }

    impl LiveView {
        /// Opens the port and advertises the topics of a recording that is made by `recording`.
        pub(crate) fn start(
            config: FoxgloveConfig,
            recording: &RecorderConfig,
            cell_name: &str,
        ) -> Result<Self, LiveViewError> {
            let listen = config.listen;
            let failed = |cause: String| LiveViewError::Listen { listen, cause };
            let context = Context::new();
            let described = descriptions(recording.image_encoding != ImageEncoding::Raw);
            let channels = described.into_iter().map(|topic| {
                let channel = ChannelBuilder::new(topic.name).message_encoding(topic.message_encoding);
                channel.schema(topic.schema).context(&context).build_raw()
            });
            let channels = channels.collect::<Result<Vec<_>, _>>().map_err(|e| failed(e.to_string()))?;
            let server = WebSocketServer::new()
                .name(format!("samsod {cell_name}"))
                .bind(listen.ip().to_string(), listen.port())
                .message_backlog_size(BACKLOG_MESSAGES)
                .context(&context);
            let (stop, stopped) = oneshot::channel();
            let (told, begun) = mpsc::sync_channel(1);
            let serve = move || {
                let result = run(server, &told, stopped);
                // Nobody waits any more once it has begun.
                let _ = result.map_err(|cause| told.send(Err(cause)));
            };
            let thread = thread::Builder::new().name("live view".to_owned()).spawn(serve);
            let thread = thread.map_err(|e| failed(e.to_string()))?;
            let port = begun.recv().unwrap_or_else(|_| Err("its thread panicked".to_owned())).map_err(failed)?;
            let address = SocketAddr::new(listen.ip(), port);
            info!(%address, "live view");
            if !address.ip().is_loopback() {
                warn!(%address, "whoever reaches the live view sees what is recorded: it has no token");
            }
            Ok(Self { channels, _context: context, stop: Some(stop), thread: Some(thread) })
        }

        /// Hands a message to the viewers that have subscribed to its topic.
        pub(in super::super) fn send(&self, topic: Topic, timestamp_ns: u64, data: &[u8]) {
            if let Some(channel) = self.channels.get(topic as usize).filter(|channel| channel.has_sinks()) {
                channel.log_with_meta(data, PartialMetadata { log_time: Some(timestamp_ns) });
            }
        }
    }

    /// Serves until it is told to stop; tells the port once it is open.
    fn run(
        server: WebSocketServer,
        told: &mpsc::SyncSender<Result<u16, String>>,
        stopped: oneshot::Receiver<()>,
    ) -> Result<(), String> {
        let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build();
        let runtime = runtime.map_err(|e| e.to_string())?;
        let cause_of = |e: FoxgloveError| e.to_string();
        let handle = runtime.block_on(server.start()).map_err(cause_of)?;
        // Whoever started this waits for it.
        let _ = told.send(Ok(handle.port()));
        // Ends with a message, or with the sender.
        let _ = runtime.block_on(stopped);
        // Viewers are not waited for.
        drop(handle.stop());
        runtime.shutdown_background();
        Ok(())
    }

    impl Drop for LiveView {
        fn drop(&mut self) {
            drop(self.stop.take());
            if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
                error!("the thread of the live view panicked");
            }
        }
    }
}
