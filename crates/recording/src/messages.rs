//! The messages of a file, strictly: what lies before damage is returned, together with what the damage is.

use std::path::Path;
use std::sync::Arc;

use mcap::read::ChannelAccumulator;
use mcap::records::{Record, op};
use mcap::{Channel, Message};

use crate::ReadError;
use crate::records::{RecordFile, Unpacker, parse};

/// Streams the messages of a file in their order, up to its end or to the first damage. Memory scales with the largest record, not
/// with the length of the file.
pub struct Messages {
    file: RecordFile,
    /// Where the next record of the file begins.
    at: u64,
    /// The chunk that is being unpacked, and whether the file is cut off in it.
    chunk: Option<(Unpacker, bool)>,
    channels: ChannelAccumulator<'static>,
    past_data_end: bool,
    length: u64,
    is_done: bool,
}

const CUT_OFF: &str = "the file ends in the middle of a record";

impl Messages {
    /// Opens a file.
    ///
    /// # Errors
    /// [`ReadError::Io`], or [`ReadError::NoRecording`] for what does not begin as MCAP files do.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let file = RecordFile::open(path)?;
        let length = file.length();
        let (at, channels) = (mcap::MAGIC.len() as u64, ChannelAccumulator::default());
        Ok(Self { file, at, chunk: None, channels, past_data_end: false, length, is_done: false })
    }

    /// The next message, `None` at the end, or in the inner result what is broken; after that nothing comes.
    ///
    /// # Errors
    /// [`ReadError::Io`]
    #[allow(
        clippy::should_implement_trait,
        clippy::type_complexity,
        reason = "an iterator cannot tell damage from errors"
    )]
    pub fn next(&mut self) -> Result<Option<Result<Message<'static>, String>>, ReadError> {
        if self.is_done {
            return Ok(None);
        }
        let message = self.next_message().map_or_else(
            |stopped| match stopped {
                Stopped::Damage(damage) => Ok(Some(Err(damage))),
                Stopped::Error(error) => Err(error),
            },
            |message| Ok(message.map(Ok)),
        );
        self.is_done = !matches!(message, Ok(Some(Ok(_))));
        message
    }

    fn next_message(&mut self) -> Result<Option<Message<'static>>, Stopped> {
        loop {
            if let Some((unpacker, is_cut_off)) = &mut self.chunk {
                match unpacker.next(&mut self.file)? {
                    Some(Ok((opcode, body))) => match self.take_in(opcode, &body)? {
                        Some(message) => return Ok(Some(message)),
                        None => continue,
                    },
                    _ if *is_cut_off => return Err(Stopped::Damage(CUT_OFF.to_owned())),
                    Some(Err(damage)) => return Err(Stopped::Damage(damage)),
                    None => self.chunk = None,
                }
            }
            let Some(head) = self.file.head(self.at)? else {
                let cause = if self.at == self.length { "the file was not closed" } else { CUT_OFF };
                return Err(Stopped::Damage(cause.to_owned()));
            };
            self.at = head.end();
            let is_whole = self.file.fits(&head);
            if head.opcode == op::CHUNK && !self.past_data_end {
                let chunk = self.file.chunk(&head)?.map_err(Stopped::Damage)?;
                let unpacker = if is_whole {
                    Unpacker::whole(&mut self.file, &chunk)?.map_err(Stopped::Damage)?
                } else {
                    Unpacker::cut_off(&mut self.file, &chunk)?
                };
                self.chunk = Some((unpacker, !is_whole));
                continue;
            }
            if !is_whole {
                let cause = if self.at > self.length { CUT_OFF } else { "there is something that is no record" };
                return Err(Stopped::Damage(cause.to_owned()));
            }
            match head.opcode {
                op::FOOTER => {
                    let magic = mcap::MAGIC.len() as u64;
                    let rest = self.length - self.at;
                    let is_closed = rest >= magic && self.file.bytes(self.at, magic)? == mcap::MAGIC;
                    let damage = || Stopped::Damage("the magic of MCAP is missing at the end".to_owned());
                    return is_closed.then_some(None).ok_or_else(damage);
                }
                op::DATA_END => self.past_data_end = true,
                op::SCHEMA | op::CHANNEL | op::MESSAGE if !self.past_data_end => {
                    let body = self.file.body(&head)?.to_vec();
                    if let Some(message) = self.take_in(head.opcode, &body)? {
                        return Ok(Some(message));
                    }
                }
                _ => {}
            }
        }
    }

    /// A record from inside or outside of a chunk.
    fn take_in(&mut self, opcode: u8, body: &[u8]) -> Result<Option<Message<'static>>, Stopped> {
        if ![op::SCHEMA, op::CHANNEL, op::MESSAGE].contains(&opcode) {
            return Ok(None);
        }
        let damage = |error: mcap::McapError| Stopped::Damage(error.to_string());
        match parse(opcode, body).map_err(Stopped::Damage)? {
            Record::Schema { header, data } => {
                self.channels.add_schema(header, data.into_owned().into()).map_err(damage)?;
            }
            Record::Channel(channel) => self.channels.add_channel(channel).map_err(damage)?,
            Record::Message { header, data } => {
                let id = header.channel_id;
                let Some(channel) = self.channels.get(id) else {
                    return Err(Stopped::Damage(format!("a message of channel {id}, which is not described")));
                };
                return Ok(Some(Message {
                    channel,
                    sequence: header.sequence,
                    log_time: header.log_time,
                    publish_time: header.publish_time,
                    data: data.into_owned().into(),
                }));
            }
            _ => {}
        }
        Ok(None)
    }

    /// Every channel that was seen so far, by its number.
    pub fn channels(&self) -> impl Iterator<Item = Arc<Channel<'static>>> {
        (0..=u16::MAX).filter_map(|id| self.channels.get(id))
    }

    /// Size of the file.
    pub fn file_bytes(&self) -> u64 {
        self.length
    }
}

impl std::fmt::Debug for Messages {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Messages").field("at", &self.at).finish_non_exhaustive()
    }
}

/// Why no further message comes.
enum Stopped {
    Damage(String),
    Error(ReadError),
}

impl From<ReadError> for Stopped {
    fn from(error: ReadError) -> Self {
        Self::Error(error)
    }
}
