//! How a process joins the shared memory of a cell: configuration, naming and errors.

use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use iceoryx2::config::Config;
use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::port_factory::{event, publish_subscribe};
use serde::{Deserialize, Serialize};

use crate::{FrameError, half_made, room, root};

/// The variant of iceoryx2 in use: inter-process, and its ports may move to another thread.
pub(crate) type Ipc = ipc_threadsafe::Service;
pub(crate) type PubSub<H> = publish_subscribe::PortFactory<Ipc, [u8], H>;

/// Event id that a publisher notifies after each send.
pub const SENT_EVENT: usize = 1;

/// Publishers of frames at a time: the one in service, and the one that takes over from it.
const MAX_PUBLISHERS: usize = 2;
/// Longest sleep at a time: the transport need not cope with any duration.
const LONGEST_SLEEP: Duration = Duration::from_secs(3600);
/// How long another participant may take to clean up behind one that was killed.
const CLEANUP_PATIENCE: Duration = Duration::from_secs(1);
/// How long a service that is half made is waited for; each attempt takes a second.
const SERVICE_PATIENCE: Duration = Duration::from_secs(4);
/// Processes that may take part in one service of a cell.
const MAX_NODES: usize = 16;

/// How a process finds the frames and scenes of a cell, and how much shared memory they may take.
///
/// Whoever comes first creates the services with its numbers; later participants must ask for no more.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameServiceConfig {
    /// Name of the cell: 1 to 64 of `a-z A-Z 0-9 _ - .`, not starting with a dot.
    pub cell: String,
    /// Folder of the transport's bookkeeping files; by default that of iceoryx2, `/tmp/iceoryx2`. All participants
    /// must name the same. At most [`FrameServiceConfig::MAX_ROOT_PATH`] bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub root_path: Option<PathBuf>,
    /// Largest frame a publisher may send, bytes.
    pub max_frame_bytes: usize,
    /// Frames that wait for a subscriber before the oldest is overwritten.
    pub buffer_frames: usize,
    /// Frames a subscriber may hold at a time.
    pub borrowed_frames: usize,
    /// Subscribers of frames, and of scenes, at a time.
    pub max_subscribers: usize,
    /// Largest scene that is published, bytes.
    pub max_scene_bytes: usize,
}

impl Default for FrameServiceConfig {
    fn default() -> Self {
        Self {
            cell: "cell".to_owned(),
            root_path: None,
            max_frame_bytes: 2048 * 1536 * 3,
            buffer_frames: 2,
            borrowed_frames: 2,
            max_subscribers: 4,
            max_scene_bytes: 256 * 1024,
        }
    }
}

impl FrameServiceConfig {
    /// Longest root path, bytes: the names of unix sockets below it may not exceed 108 bytes.
    pub const MAX_ROOT_PATH: usize = 40;

    /// The defaults, for the cell of this name.
    pub fn for_cell(cell: impl Into<String>) -> Self {
        Self { cell: cell.into(), ..Self::default() }
    }

    /// Slots of `max_frame_bytes` that a publisher of frames reserves, one of them for itself.
    pub fn slots(&self) -> usize {
        (self.buffer_frames + self.borrowed_frames) * self.max_subscribers + 1
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`ServiceError::CellName`], [`ServiceError::Setting`] or [`ServiceError::RootPath`], with what is allowed.
    pub fn check(&self) -> Result<(), ServiceError> {
        let named = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
        if self.cell.is_empty() || self.cell.len() > 64 || self.cell.starts_with('.') || !self.cell.chars().all(named) {
            return Err(ServiceError::CellName { cell: self.cell.clone() });
        }
        let settings = [
            ("max_frame_bytes", self.max_frame_bytes, 1, 1 << 30),
            ("buffer_frames", self.buffer_frames, 1, 64),
            ("borrowed_frames", self.borrowed_frames, 1, 64),
            ("max_subscribers", self.max_subscribers, 1, 16),
            ("max_scene_bytes", self.max_scene_bytes, 64, 64 << 20),
        ];
        for (key, value, min, max) in settings {
            if value < min || value > max {
                return Err(ServiceError::Setting { key, value, min, max });
            }
        }
        self.transport_root().map(|_| ())
    }

    /// Checks that the root path, if it exists, belongs to this user alone: who may write there may take part in the cell.
    ///
    /// # Errors
    /// [`ServiceError::RootPath`], with the reason.
    pub fn check_root(&self) -> Result<(), ServiceError> {
        self.root_path.as_deref().map_or(Ok(()), check_root)
    }

    fn transport_root(&self) -> Result<Option<Path>, ServiceError> {
        let Some(root) = &self.root_path else { return Ok(None) };
        let error = |reason: String| ServiceError::RootPath { path: root.clone(), reason };
        let text = root.to_str().ok_or_else(|| error("it is not UTF-8".to_owned()))?;
        if !root.is_absolute() {
            return Err(error("it must be absolute".to_owned()));
        }
        if text.len() > Self::MAX_ROOT_PATH {
            return Err(error(format!("it has {} bytes, at most {} are allowed", text.len(), Self::MAX_ROOT_PATH)));
        }
        Path::new(text.as_bytes()).map(Some).map_err(|e| error(format!("{e:?}")))
    }

    fn service_name(&self, topic: &str) -> Result<(String, ServiceName), ServiceError> {
        let name = format!("samsod/{}/{topic}", self.cell);
        match ServiceName::new(&name) {
            Ok(service) => Ok((name, service)),
            Err(_) => Err(ServiceError::CellName { cell: self.cell.clone() }),
        }
    }
}

/// Why a process could not take part in a cell.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The name of the cell cannot name a service.
    #[error("cell name {cell:?} must be 1 to 64 of a-z A-Z 0-9 _ - . and not start with a dot")]
    CellName {
        /// The name given.
        cell: String,
    },
    /// A number of the configuration is out of range.
    #[error("{key} is {value}; {min} to {max} are allowed")]
    Setting {
        /// Key in the configuration.
        key: &'static str,
        /// The value given.
        value: usize,
        /// Smallest value.
        min: usize,
        /// Largest value.
        max: usize,
    },
    /// The root path cannot be used.
    #[error("root_path {}: {reason}", path.display())]
    RootPath {
        /// The path given.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Another user owns the bookkeeping files, or they cannot be created.
    #[error(
        "cannot join shared memory below {}: {reason}; all participants of a cell run under one user id, \
         or each under its own root_path", root.display()
    )]
    Join {
        /// Folder of the bookkeeping files.
        root: PathBuf,
        /// What the transport says.
        reason: String,
    },
    /// A service exists, but cannot be shared with this process.
    #[error("service {service}: {reason}")]
    Open {
        /// Name of the service.
        service: String,
        /// What the transport says, and what it means.
        reason: String,
    },
    /// There is no room for what a publisher may need.
    #[error(
        "service {service}: {needed_bytes} bytes are needed in /dev/shm, {free_bytes} are free; free some, make the frames smaller,          or give /dev/shm more (of a container: --shm-size)"
    )]
    NoRoom {
        /// Name of the service.
        service: String,
        /// What all slots take.
        needed_bytes: u64,
        /// What is free.
        free_bytes: u64,
    },
    /// All places of this kind are taken.
    #[error("service {service} already has its {limit} {role}s; end one of them first")]
    Full {
        /// Name of the service.
        service: String,
        /// `"publisher"` or `"subscriber"`.
        role: &'static str,
        /// How many there may be.
        limit: usize,
    },
}

/// Why a frame or scene was not sent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// The header does not describe an acceptable frame.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A slot was sent by another publisher than the one that it was taken of.
    #[error("the slot was taken of another publisher")]
    ForeignSlot,
    /// The message is larger than the slots that were reserved.
    #[error("{bytes} bytes do not fit into a slot of {max} bytes; raise {key}")]
    TooLarge {
        /// Size of the message, bytes.
        bytes: usize,
        /// Size of a slot, bytes.
        max: usize,
        /// The setting that bounds it.
        key: &'static str,
    },
    /// The transport failed.
    #[error("cannot send to {service}: {reason}")]
    Transport {
        /// Name of the service.
        service: String,
        /// What the transport says.
        reason: String,
    },
}

/// Why nothing was received. A rejected frame is one of a stream: the next may be good.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// A frame came, but its header is wrong.
    #[error("frame {sequence} rejected: {source}")]
    Rejected {
        /// Sequence number in its header.
        sequence: u64,
        /// What is wrong.
        source: FrameError,
    },
    /// The caller holds as many frames as it may.
    #[error("{held} frames are held, no more are allowed; drop one first (borrowed_frames)")]
    TooManyHeld {
        /// How many may be held.
        held: usize,
    },
    /// The transport failed.
    #[error("cannot receive from {service}: {reason}")]
    Transport {
        /// Name of the service.
        service: String,
        /// What the transport says.
        reason: String,
    },
}

/// The time since the Unix epoch, ns; 0 for a clock set before it.
pub fn unix_time_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX))
}

/// One topic of a cell as a process has opened it. The node lives as long as the services hold it.
#[derive(Debug)]
pub(crate) struct Topic<H: std::fmt::Debug + Default + ZeroCopySend> {
    pub(crate) name: String,
    pub(crate) messages: PubSub<H>,
    events: event::PortFactory<Ipc>,
    node: Node<Ipc>,
}

/// Buffering of one topic.
pub(crate) struct TopicLimits {
    pub(crate) buffer: usize,
    pub(crate) borrowed: usize,
}

impl<H: std::fmt::Debug + Default + ZeroCopySend> Topic<H> {
    /// Joins or creates a topic. Dead participants are cleaned up on the way.
    pub(crate) fn open(config: &FrameServiceConfig, topic: &str, limits: &TopicLimits) -> Result<Self, ServiceError> {
        config.check()?;
        // Its default level reports a missing configuration file, which is not used here, on every start.
        set_log_level_from_env_or(LogLevel::Error);
        let (name, service) = config.service_name(topic)?;
        // Not the global configuration: that is read from a file in whatever folder the process was started in.
        let mut transport = Config::default();
        if let Some(root) = config.transport_root()? {
            transport.global.set_root_path(&root);
        }
        transport.global.node.cleanup_dead_nodes_on_creation = true;
        let root = PathBuf::from(transport.global.root_path().to_string());
        check_root(&root)?;
        let join = |e: NodeCreationFailure| ServiceError::Join { root: root.clone(), reason: format!("{e:?}") };
        let node = NodeBuilder::new()
            .config(&transport)
            // The process owns its signals; the transport must not install handlers of its own.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(join)?;

        half_made::remove_nodes(&root);
        // Another participant may be at it, too: its work is waited for.
        node.blocking_cleanup_dead_nodes(CLEANUP_PATIENCE);
        let open = |reason: String| ServiceError::Open { service: name.clone(), reason };
        let events = open_service(&node, &root, &service, MessagingPattern::Event, || {
            node.service_builder(&service)
                .event()
                .max_nodes(MAX_NODES)
                .max_notifiers(MAX_PUBLISHERS)
                .max_listeners(config.max_subscribers)
                .open_or_create()
        });
        let events = events.map_err(|e: EventOpenOrCreateError| open(explain(&e)))?;
        let messages = open_service(&node, &root, &service, MessagingPattern::PublishSubscribe, || {
            node.service_builder(&service)
                .publish_subscribe::<[u8]>()
                .user_header::<H>()
                // No payload_alignment: iceoryx2 0.10 rounds every element of a slice up to it, so that of bytes to 64 would
                // reserve 64 times the memory. Rows of packed RGB are not aligned anyway.
                // A slow or killed subscriber must never hold up the publisher.
                .enable_safe_overflow(true)
                .history_size(0)
                .subscriber_max_buffer_size(limits.buffer)
                .subscriber_max_borrowed_samples(limits.borrowed)
                .max_publishers(MAX_PUBLISHERS)
                .max_subscribers(config.max_subscribers)
                .max_nodes(MAX_NODES)
                .open_or_create()
        });
        let messages = messages.map_err(|e: PublishSubscribeOpenOrCreateError| open(explain(&e)))?;
        Ok(Self { name, messages, events, node })
    }

    /// Makes a port. Places of participants that have been killed are made free first, if there is none.
    fn make_port<P, E>(&self, is_full: impl Fn(&E) -> bool, make: impl Fn() -> Result<P, E>) -> Result<P, E> {
        match make() {
            Err(e) if is_full(&e) => {
                let cleanup = self.node.blocking_cleanup_dead_nodes(CLEANUP_PATIENCE);
                if cleanup.cleanups + cleanup.failed_cleanups > 0 { make() } else { Err(e) }
            }
            made => made,
        }
    }

    pub(crate) fn notifier(&self) -> Result<Notifier<Ipc>, ServiceError> {
        use iceoryx2::port::notifier::NotifierCreateError as E;
        let sent = EventId::new(SENT_EVENT);
        let make = || self.events.notifier_builder().default_event_id(sent).create();
        self.make_port(|e| matches!(e, E::ExceedsMaxSupportedNotifiers), make).map_err(|e| match e {
            E::ExceedsMaxSupportedNotifiers => self.full("publisher", MAX_PUBLISHERS),
            e => self.open_error(format!("{e:?}")),
        })
    }

    pub(crate) fn listener(&self) -> Result<Listener<Ipc>, ServiceError> {
        use iceoryx2::port::listener::ListenerCreateError as E;
        let make = || self.events.listener_builder().create();
        self.make_port(|e| matches!(e, E::ExceedsMaxSupportedListeners), make).map_err(|e| match e {
            E::ExceedsMaxSupportedListeners => self.full("subscriber", self.events.static_config().max_listeners()),
            e => self.open_error(format!("{e:?}")),
        })
    }

    /// A publisher with all of its memory: what a full `/dev/shm` has no room for is told here, and not by a signal later.
    pub(crate) fn publisher(
        &self,
        max_bytes: usize,
        loans: usize,
    ) -> Result<iceoryx2::port::publisher::Publisher<Ipc, [u8], H>, ServiceError> {
        use iceoryx2::port::publisher::PublisherCreateError as E;
        let limits = self.messages.static_config();
        let held = limits.subscriber_max_buffer_size() + limits.subscriber_max_borrowed_samples();
        let needed_bytes = room::needed_bytes(held * limits.max_subscribers() + loans, max_bytes);
        let no_room = |free_bytes| ServiceError::NoRoom { service: self.name.clone(), needed_bytes, free_bytes };
        if let Some(free_bytes) = room::free_bytes().filter(|free| *free < needed_bytes) {
            return Err(no_room(free_bytes));
        }
        let make =
            || self.messages.publisher_builder().initial_max_slice_len(max_bytes).max_loaned_samples(loans).create();
        let port = self.make_port(|e| matches!(e, E::ExceedsMaxSupportedPublishers), make).map_err(|e| match e {
            E::ExceedsMaxSupportedPublishers => self.full("publisher", MAX_PUBLISHERS),
            e => self.open_error(format!("{e:?}")),
        })?;
        {
            let slot = port.loan_slice_uninit(max_bytes).map_err(|e| self.open_error(format!("{e:?}")))?;
            // Somebody else may have taken the room meanwhile.
            room::take_mapping(slot.payload().as_ptr().cast()).map_err(|_| no_room(room::free_bytes().unwrap_or(0)))?;
        }
        Ok(port)
    }

    pub(crate) fn subscriber(&self) -> Result<iceoryx2::port::subscriber::Subscriber<Ipc, [u8], H>, ServiceError> {
        use iceoryx2::port::subscriber::SubscriberCreateError as E;
        let make = || self.messages.subscriber_builder().create();
        self.make_port(|e| matches!(e, E::ExceedsMaxSupportedSubscribers), make).map_err(|e| match e {
            E::ExceedsMaxSupportedSubscribers => {
                self.full("subscriber", self.messages.static_config().max_subscribers())
            }
            e => self.open_error(format!("{e:?}")),
        })
    }

    fn full(&self, role: &'static str, limit: usize) -> ServiceError {
        ServiceError::Full { service: self.name.clone(), role, limit }
    }

    fn open_error(&self, reason: String) -> ServiceError {
        ServiceError::Open { service: self.name.clone(), reason }
    }

    pub(crate) fn send_error(&self, error: impl std::fmt::Debug) -> SendError {
        SendError::Transport { service: self.name.clone(), reason: format!("{error:?}") }
    }

    pub(crate) fn receive_error(&self, error: iceoryx2::port::ReceiveError) -> ReceiveError {
        match error {
            iceoryx2::port::ReceiveError::ExceedsMaxBorrows => {
                ReceiveError::TooManyHeld { held: self.messages.static_config().subscriber_max_borrowed_samples() }
            }
            e => ReceiveError::Transport { service: self.name.clone(), reason: format!("{e:?}") },
        }
    }

    /// Sleeps until a publisher notifies or the deadline passes. False: the caller should look no further, either
    /// because the deadline passed or because a signal came and the process may want to end. No deadline is one that lies
    /// beyond what the clock can tell.
    pub(crate) fn sleep(&self, listener: &Listener<Ipc>, deadline: Option<Instant>) -> Result<bool, ReceiveError> {
        let left = deadline.map_or(LONGEST_SLEEP, |deadline| deadline.saturating_duration_since(Instant::now()));
        if left.is_zero() {
            return Ok(false);
        }
        // The transport sleeps in whole milliseconds and must not spin over the last fraction.
        match listener.timed_wait(|_| (), left.clamp(Duration::from_millis(1), LONGEST_SLEEP)) {
            Ok(_) => Ok(true),
            Err(ListenerWaitError::InterruptSignal) => Ok(false),
            Err(e) => Err(ReceiveError::Transport { service: self.name.clone(), reason: format!("{e:?}") }),
        }
    }
}

/// Opens or makes a service, also one that a participant has left half made because it was killed meanwhile.
fn open_service<T, E: std::fmt::Debug>(
    node: &Node<Ipc>,
    root: &std::path::Path,
    name: &ServiceName,
    pattern: MessagingPattern,
    open: impl Fn() -> Result<T, E>,
) -> Result<T, E> {
    // It is being made or removed at the moment, or hangs so.
    let may_pass = |e: &E| {
        let text = format!("{e:?}");
        ["HangsInCreation", "BeingCreated", "MarkedForDestruction", "InFlux", "Corrupted"]
            .iter()
            .any(|s| text.contains(s))
    };
    let deadline = Instant::now() + SERVICE_PATIENCE;
    loop {
        match open() {
            Err(e) if may_pass(&e) => {}
            opened => return opened,
        }
        node.blocking_cleanup_dead_nodes(CLEANUP_PATIENCE);
        half_made::remove_services(root);
        if Instant::now() >= deadline {
            // SAFETY: nobody uses it, for it has never been complete: a living participant makes one in some milliseconds, and
            // all attempts since have waited for that.
            let _ = unsafe { node.force_remove_service(name, pattern) };
            return open();
        }
    }
}

fn check_root(root: &std::path::Path) -> Result<(), ServiceError> {
    match root::objection(root) {
        Some(reason) => Err(ServiceError::RootPath { path: root.to_owned(), reason }),
        None => Ok(()),
    }
}

/// What an error of the transport means to an operator.
fn explain(error: &impl std::fmt::Debug) -> String {
    let text = format!("{error:?}");
    let hint = if text.contains("IncompatibleTypes") {
        "a participant speaks another version of the header"
    } else if text.contains("Permission") {
        "another user owns it; all participants of a cell run under one user id"
    } else if text.contains("DoesNotSupport") {
        "it exists with smaller limits; end all participants or lower buffer_frames, borrowed_frames, max_subscribers"
    } else if text.contains("ExceedsMaxNumberOfNodes") {
        "too many processes take part in it"
    } else {
        return text;
    };
    format!("{text}: {hint}")
}
