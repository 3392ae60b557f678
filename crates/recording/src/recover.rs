//! Makes a whole recording of what is left of one that was cut off or damaged.
//!
//! In: an MCAP file, by samsod or anybody. Out: a new one with everything that can be read of it: schemas, channels, messages in
//! their order, metadata, attachments and private records, with an index; and a [`Recovery`] that says what was lost. The new file is
//! read back and compared before it counts, the old one is not touched.
//!
//! Nothing is made up: a chunk whose checksum is wrong is left out as a whole. Of the chunk at whose end the file was cut off, whole
//! records are taken; they have no checksum to be held against. Where something is unreadable, reading goes on at the next place that
//! looks like a record.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::hash::{DefaultHasher, Hasher};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{self, MessageHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::write::PrivateRecordOptions;

use crate::records::{Head, RecordFile, Unpacker, parse};
use crate::{ReadError, cause_of, is_in_use};

/// Size of a chunk of the new file before compression, bytes.
const CHUNK_BYTES: u64 = 4 << 20;

/// Why nothing was recovered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecoverError {
    /// The file cannot be read, or is no recording.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// samsodd writes to the file at the moment.
    #[error("{} is being recorded to; it is whole when samsodd has ended or begun its next file", path.display())]
    InUse {
        /// The file.
        path: PathBuf,
    },
    /// The new file is there already, or cannot be made.
    #[error("cannot make {}: {cause}; nothing is written over, --out names another file", path.display())]
    Create {
        /// The new file.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// The new file could not be written; what there was of it is removed.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The new file.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
    /// The new file does not hold what was written to it; it is removed.
    #[error("{} was not read back as it was written: {cause}", path.display())]
    Verify {
        /// The new file.
        path: PathBuf,
        /// What differs.
        cause: String,
    },
}

/// What was recovered, and what was not.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovery {
    /// All topics, by name, also those without messages.
    pub topics: Vec<RecoveredTopic>,
    /// Attachments in the new file.
    pub attachments: u64,
    /// Metadata records in the new file.
    pub metadata: u64,
    /// Places of the old file that could not be read, in their order.
    pub losses: Vec<Loss>,
    /// Whether the old file was closed, with an index and all.
    pub was_closed: bool,
    /// Size of the old file, bytes.
    pub bytes: u64,
    /// Size of the new file, bytes.
    pub bytes_recovered: u64,
}

impl Recovery {
    /// Whether anything could not be read. A file that ends behind a whole record has lost nothing that can be known of.
    pub fn has_lost_data(&self) -> bool {
        !self.losses.is_empty()
    }

    /// Messages in the new file.
    pub fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.recovered).sum()
    }
}

/// Messages of one topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RecoveredTopic {
    /// Its name.
    pub name: String,
    /// In the new file.
    pub recovered: u64,
    /// Lost in chunks that are damaged while their index says how many they held; there may have been more.
    pub lost: u64,
}

/// A place of the old file that could not be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Loss {
    /// Where it begins, bytes from the start of the file.
    pub at: u64,
    /// Its length, bytes; 0 if it is not known where the damage is.
    pub bytes: u64,
    /// What is wrong there.
    pub what: String,
}

/// Where the recovered file lies if nobody says: beside the old one.
pub fn recovered_path(file: &Path) -> PathBuf {
    let mut name = file.file_stem().unwrap_or_default().to_os_string();
    name.push("-recovered.mcap");
    file.with_file_name(name)
}

/// Writes everything that can be read of `file` to the new file `out`, and reads that back.
///
/// # Errors
/// [`RecoverError`]; there is then no file `out` but one that was there before. Damage of `file` is no error, but told in the
/// [`Recovery`].
pub fn recover(file: &Path, out: &Path) -> Result<Recovery, RecoverError> {
    let mut source = RecordFile::open(file)?;
    if is_in_use(source.handle()) {
        return Err(RecoverError::InUse { path: file.to_path_buf() });
    }
    let (profile, compression) = style(&mut source)?;
    let new = File::create_new(out).map_err(|cause| RecoverError::Create { path: out.to_path_buf(), cause })?;
    let recovered = Salvage::new(&mut source, new, out, profile, compression).and_then(|salvage| salvage.run(file));
    recovered.inspect_err(|_| {
        // It was made here, and is not what it should be.
        let _ = std::fs::remove_file(out);
    })
}

/// Profile and compression of a file, for the new one.
fn style(source: &mut RecordFile) -> Result<(String, Option<mcap::Compression>), ReadError> {
    let (mut profile, mut at) = (String::new(), mcap::MAGIC.len() as u64);
    while let Some(head) = source.head(at)? {
        if head.opcode == op::CHUNK {
            let compression = source.chunk(&head)?.map(|chunk| chunk.compression).unwrap_or_default();
            let compression = match compression.as_str() {
                "zstd" => Some(mcap::Compression::Zstd),
                "lz4" => Some(mcap::Compression::Lz4),
                _ => None,
            };
            return Ok((profile, compression));
        }
        if !source.fits(&head) || head.opcode == op::FOOTER {
            break;
        }
        if head.opcode == op::HEADER
            && let Ok(Record::Header(header)) = parse(head.opcode, source.body(&head)?)
        {
            profile = header.profile;
        }
        at = head.end();
    }
    Ok((profile, Some(mcap::Compression::Zstd)))
}

/// What a file holds, to compare two by: counts, and a hash over everything in its order.
#[derive(Debug, Clone, Default)]
struct Digest {
    messages: BTreeMap<u16, u64>,
    hash: DefaultHasher,
    attachments: u64,
    metadata: u64,
}

impl Digest {
    fn message(&mut self, header: &MessageHeader, data: &[u8]) {
        *self.messages.entry(header.channel_id).or_default() += 1;
        self.hash.write_u16(header.channel_id);
        self.hash.write_u32(header.sequence);
        self.hash.write_u64(header.log_time);
        self.hash.write_u64(header.publish_time);
        self.bytes(data);
    }

    fn attachment(&mut self, header: &records::AttachmentHeader, data: &[u8]) {
        self.attachments += 1;
        self.hash.write_u64(header.log_time);
        self.hash.write_u64(header.create_time);
        self.bytes(header.name.as_bytes());
        self.bytes(header.media_type.as_bytes());
        self.bytes(data);
    }

    fn metadata(&mut self, metadata: &records::Metadata) {
        self.metadata += 1;
        self.bytes(metadata.name.as_bytes());
        for (key, value) in &metadata.metadata {
            self.bytes(key.as_bytes());
            self.bytes(value.as_bytes());
        }
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.hash.write_usize(bytes.len());
        self.hash.write(bytes);
    }
}

/// A schema as it stands in the file: name, encoding, data.
type Schema = (String, String, Vec<u8>);

/// Schemas and channels of the summary, by their numbers: for messages whose own description is lost.
#[derive(Debug, Default)]
struct Descriptions {
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, records::Channel>,
}

/// On the way from the old file to the new one.
struct Salvage<'a> {
    source: &'a mut RecordFile,
    out: &'a Path,
    writer: mcap::Writer<BufWriter<File>>,
    summary: Descriptions,
    /// Written to the new file.
    schemas: BTreeSet<u16>,
    channels: BTreeMap<u16, records::Channel>,
    digest: Digest,
    lost: BTreeMap<u16, u64>,
    /// Messages of channels that are described nowhere, and where the first is.
    orphans: BTreeMap<u16, (u64, u64)>,
    recovery: Recovery,
}

impl<'a> Salvage<'a> {
    fn new(
        source: &'a mut RecordFile,
        new: File,
        out: &'a Path,
        profile: String,
        compression: Option<mcap::Compression>,
    ) -> Result<Self, RecoverError> {
        let writer = mcap::WriteOptions::new()
            .profile(profile)
            .library(concat!("samsod ", env!("CARGO_PKG_VERSION")))
            .compression(compression)
            .compression_level(1)
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            .create(BufWriter::with_capacity(1 << 16, new))
            .map_err(|e| RecoverError::Write { path: out.to_path_buf(), cause: cause_of(&e) })?;
        let summary = descriptions_of_summary(source)?;
        let recovery = Recovery { bytes: source.length(), ..Recovery::default() };
        Ok(Self {
            source,
            out,
            writer,
            summary,
            schemas: BTreeSet::new(),
            channels: BTreeMap::new(),
            digest: Digest::default(),
            lost: BTreeMap::new(),
            orphans: BTreeMap::new(),
            recovery,
        })
    }

    fn run(mut self, file: &Path) -> Result<Recovery, RecoverError> {
        self.walk()?;
        for (channel, (at, count)) in std::mem::take(&mut self.orphans) {
            self.lose(at, 0, format!("{count} messages of channel {channel}, whose description is lost"));
        }
        // What stands outside of chunks has no checksum but that of the whole file.
        if self.recovery.was_closed
            && self.recovery.losses.is_empty()
            && let Err(what) = check_sums(self.source, file)?
        {
            self.lose(0, 0, what);
        }
        self.recovery.losses.sort_by_key(|loss| loss.at);
        self.writer.finish().map_err(|e| write_error(self.out, &e))?;
        let Self { writer, out, digest, channels, lost, mut recovery, .. } = self;
        let buffered = writer.into_inner();
        let new = buffered.into_inner().map_err(|e| RecoverError::Write { path: out.into(), cause: e.to_string() })?;
        new.sync_all().map_err(|e| RecoverError::Write { path: out.into(), cause: e.to_string() })?;
        drop(new);
        recovery.bytes_recovered = verify(out, &digest)?;
        (recovery.attachments, recovery.metadata) = (digest.attachments, digest.metadata);
        let mut topics: BTreeMap<String, RecoveredTopic> = BTreeMap::new();
        for (id, channel) in channels {
            let name = channel.topic;
            let topic = topics.entry(name.clone()).or_insert(RecoveredTopic { name, ..RecoveredTopic::default() });
            topic.recovered += digest.messages.get(&id).copied().unwrap_or(0);
            topic.lost += lost.get(&id).copied().unwrap_or(0);
        }
        recovery.topics = topics.into_values().collect();
        Ok(recovery)
    }

    fn lose(&mut self, at: u64, bytes: u64, what: impl Into<String>) {
        self.recovery.losses.push(Loss { at, bytes, what: what.into() });
    }

    /// From record to record through the old file.
    fn walk(&mut self) -> Result<(), RecoverError> {
        let length = self.source.length();
        let mut at = mcap::MAGIC.len() as u64;
        // From here on it has not been looked for records yet.
        let mut unsearched = at;
        // Behind a chunk stand the indexes of its messages; `Some(true)` if the chunk is lost.
        let mut behind_chunk = None;
        loop {
            let head = match self.source.head(at)? {
                Some(head) => Some(self.source.repaired(head)?),
                None => None,
            };
            let head = match head {
                Some(head) if self.source.fits(&head) => head,
                Some(head) if head.opcode == op::CHUNK && self.is_cut_off(&head)? => {
                    self.take_cut_off(&head)?;
                    return Ok(());
                }
                head => {
                    if at == length {
                        return Ok(());
                    }
                    let found = self.source.next_record(unsearched.max(mcap::MAGIC.len() as u64))?;
                    let next = found.unwrap_or(length);
                    let what = match (head, found) {
                        (_, Some(_)) => "something that is no record",
                        (None, None) => "the file ends in the middle of a record",
                        (Some(head), None) if head.end() > length => "the file ends in the middle of a record",
                        (Some(_), None) => "something that is no record, up to the end of the file",
                    };
                    // The record before may have said too great a length.
                    let from = at.min(next);
                    self.lose(from, next - from, what);
                    (at, unsearched, behind_chunk) = (next, next.saturating_add(1), None);
                    continue;
                }
            };
            // Only what has a checksum is known to end where it says.
            let mut is_certain = false;
            match head.opcode {
                op::CHUNK => {
                    let is_lost = self.take_chunk(&head)?;
                    is_certain = !is_lost;
                    behind_chunk = Some(is_lost);
                }
                op::MESSAGE_INDEX => {
                    if let (Some(true), Ok(Record::MessageIndex(index))) =
                        (behind_chunk, parse(head.opcode, self.source.body(&head)?))
                    {
                        *self.lost.entry(index.channel_id).or_default() += index.records.len() as u64;
                    }
                }
                // An index with a damaged head, and no message: they stand in chunks, or there are no chunks.
                op::MESSAGE if behind_chunk.is_some() => {
                    self.lose(at, head.end() - at, "something that is no record");
                }
                op::DATA_END if head.length == 4 => return self.end(&head),
                op::HEADER => {}
                _ => {
                    behind_chunk = None;
                    let body = self.source.body(&head)?.to_vec();
                    match self.take(head.opcode, &body, at)? {
                        Ok(()) => is_certain = head.opcode == op::ATTACHMENT,
                        Err(what) => self.lose(at, head.end() - at, what),
                    }
                }
            }
            unsearched = if is_certain { head.end() } else { at + 1 };
            at = head.end();
        }
    }

    /// What stands behind the data is made anew: only whether it is there is of interest.
    fn end(&mut self, data_end: &Head) -> Result<(), RecoverError> {
        let magic = mcap::MAGIC.len() as u64;
        let mut at = data_end.end();
        while let Some(head) = self.source.head(at)?.filter(|head| self.source.fits(head)) {
            at = head.end();
            if head.opcode == op::FOOTER {
                let rest = self.source.length() - at;
                let is_closed = rest >= magic && self.source.bytes(at, magic)? == mcap::MAGIC;
                if is_closed && rest > magic {
                    self.lose(at + magic, rest - magic, "something behind the end of the recording");
                }
                self.recovery.was_closed = is_closed;
                return Ok(());
            }
        }
        Ok(())
    }

    /// Whether a chunk that reaches beyond the end of the file was cut off there, rather than that its length is damaged.
    fn is_cut_off(&mut self, head: &Head) -> Result<bool, RecoverError> {
        let Ok(chunk) = self.source.chunk(head)? else { return Ok(false) };
        // Inside of one that is not compressed there are records.
        Ok(chunk.compression.is_empty() || self.source.next_record(chunk.data_at)?.is_none())
    }

    fn take_cut_off(&mut self, head: &Head) -> Result<(), RecoverError> {
        let Ok(chunk) = self.source.chunk(head)? else { return Ok(()) };
        let mut unpacker = Unpacker::cut_off(self.source, &chunk)?;
        let before: u64 = self.digest.messages.values().sum();
        while let Some(Ok((opcode, body))) = unpacker.next(self.source)? {
            if self.take_from_chunk(opcode, &body, head.at)?.is_err() {
                break;
            }
        }
        let taken = self.digest.messages.values().sum::<u64>() - before;
        let what = format!("the file ends in the middle of a chunk; {taken} messages of it were read");
        self.lose(head.at, self.source.length() - head.at, what);
        Ok(())
    }

    /// A chunk is taken as a whole, when its checksum has been found right, or not at all. Returns whether it is lost.
    fn take_chunk(&mut self, head: &Head) -> Result<bool, RecoverError> {
        let lost = |salvage: &mut Self, what: &str| {
            salvage.lose(head.at, head.end() - head.at, format!("a damaged chunk: {what}"));
            Ok(true)
        };
        let chunk = match self.source.chunk(head)? {
            Ok(chunk) => chunk,
            Err(what) => return lost(self, &what),
        };
        for is_checked in [false, true] {
            let mut unpacker = match Unpacker::whole(self.source, &chunk)? {
                Ok(unpacker) => unpacker,
                Err(what) => return lost(self, &what),
            };
            while let Some(record) = unpacker.next(self.source)? {
                match record {
                    Err(what) => return lost(self, &what),
                    Ok(_) if !is_checked => {}
                    Ok((opcode, body)) => {
                        if let Err(what) = self.take_from_chunk(opcode, &body, head.at)? {
                            self.lose(head.at, 0, format!("a record in a chunk: {what}"));
                        }
                    }
                }
            }
        }
        let end = chunk.data_at + chunk.compressed_size;
        if end < head.end() {
            self.lose(end, head.end() - end, "something between the records of a chunk and its end");
        }
        Ok(false)
    }

    fn take_from_chunk(&mut self, opcode: u8, body: &[u8], at: u64) -> Result<Result<(), String>, RecoverError> {
        match opcode {
            op::SCHEMA | op::CHANNEL | op::MESSAGE => self.take(opcode, body, at),
            0x80.. => {
                let options = PrivateRecordOptions::IncludeInChunks.into();
                self.writer.write_private_record(opcode, body, options).map_err(|e| write_error(self.out, &e))?;
                Ok(Ok(()))
            }
            // Nothing else may stand there, and whoever reads it passes over it.
            _ => Ok(Ok(())),
        }
    }

    /// Takes a record over into the new file; in the inner result, why that cannot be.
    fn take(&mut self, opcode: u8, body: &[u8], at: u64) -> Result<Result<(), String>, RecoverError> {
        let record = match parse(opcode, body) {
            Ok(record) => record,
            Err(what) => return Ok(Err(what)),
        };
        match record {
            Record::Schema { header, data } => self.add_schema(header.id, &(header.name, header.encoding, data.into())),
            Record::Channel(channel) => self.add_channel(channel),
            Record::Message { header, data } => {
                if !self.knows(header.channel_id)? {
                    let orphans = self.orphans.entry(header.channel_id).or_insert((at, 0));
                    orphans.1 += 1;
                    *self.lost.entry(header.channel_id).or_default() += 1;
                    return Ok(Ok(()));
                }
                self.writer.write_to_known_channel(&header, &data).map_err(|e| write_error(self.out, &e))?;
                self.digest.message(&header, &data);
                Ok(Ok(()))
            }
            Record::Attachment { header, data, .. } => {
                let attachment = mcap::Attachment {
                    log_time: header.log_time,
                    create_time: header.create_time,
                    name: header.name.clone(),
                    media_type: header.media_type.clone(),
                    data: data.as_ref().into(),
                };
                self.writer.attach(&attachment).map_err(|e| write_error(self.out, &e))?;
                self.digest.attachment(&header, &data);
                Ok(Ok(()))
            }
            Record::Metadata(metadata) => {
                self.writer.write_metadata(&metadata).map_err(|e| write_error(self.out, &e))?;
                self.digest.metadata(&metadata);
                Ok(Ok(()))
            }
            Record::Unknown { opcode: opcode @ 0x80.., data } => {
                let options = Default::default();
                self.writer.write_private_record(opcode, &data, options).map_err(|e| write_error(self.out, &e))?;
                Ok(Ok(()))
            }
            _ => Ok(Err("a record that does not belong here".to_owned())),
        }
    }

    fn add_schema(&mut self, id: u16, schema: &Schema) -> Result<Result<(), String>, RecoverError> {
        let (name, encoding, data) = schema;
        match self.writer.add_schema_with_id(id, name, encoding, data) {
            Ok(id) => {
                self.schemas.insert(id);
                Ok(Ok(()))
            }
            Err(e @ (mcap::McapError::InvalidSchemaId | mcap::McapError::ConflictingSchemas(_))) => {
                Ok(Err(e.to_string()))
            }
            Err(e) => Err(write_error(self.out, &e)),
        }
    }

    fn add_channel(&mut self, channel: records::Channel) -> Result<Result<(), String>, RecoverError> {
        let mut schema_id = channel.schema_id;
        let mut without = Ok(());
        if schema_id != 0 && !self.schemas.contains(&schema_id) {
            let known = self.summary.schemas.get(&schema_id).cloned();
            let added = match &known {
                Some(schema) => self.add_schema(schema_id, schema)?.is_ok(),
                None => false,
            };
            if !added {
                // Its messages are worth more than their schema.
                without = Err(format!("the schema of topic {} is lost", channel.topic));
                schema_id = 0;
            }
        }
        let records::Channel { id, topic, message_encoding, metadata, .. } = &channel;
        match self.writer.add_channel_with_id(*id, schema_id, topic, message_encoding, metadata) {
            Ok(id) => {
                self.channels.entry(id).or_insert(channel);
                Ok(without)
            }
            Err(e @ mcap::McapError::ConflictingChannels(_)) => Ok(Err(e.to_string())),
            Err(e) => Err(write_error(self.out, &e)),
        }
    }

    /// Whether a channel is described, in the end by the summary.
    fn knows(&mut self, channel: u16) -> Result<bool, RecoverError> {
        if self.channels.contains_key(&channel) {
            return Ok(true);
        }
        match self.summary.channels.get(&channel).cloned() {
            Some(described) => {
                // What the schema says against it does not hinder the messages.
                let _ = self.add_channel(described)?;
                Ok(self.channels.contains_key(&channel))
            }
            None => Ok(false),
        }
    }
}

fn write_error(out: &Path, error: &mcap::McapError) -> RecoverError {
    RecoverError::Write { path: out.to_path_buf(), cause: cause_of(error) }
}

/// Schemas and channels as the summary at the end of a closed file repeats them; none if there is no such end.
fn descriptions_of_summary(source: &mut RecordFile) -> Result<Descriptions, ReadError> {
    let mut found = Descriptions::default();
    let magic = mcap::MAGIC.len() as u64;
    // Head, two places, checksum.
    let footer_bytes = 9 + 8 + 8 + 4;
    let length = source.length();
    if length < 2 * magic + footer_bytes || source.bytes(length - magic, magic)? != mcap::MAGIC {
        return Ok(found);
    }
    let Some(head) = source.head(length - magic - footer_bytes)?.filter(|head| head.opcode == op::FOOTER) else {
        return Ok(found);
    };
    if head.end() != length - magic {
        return Ok(found);
    }
    let Ok(Record::Footer(footer)) = parse(op::FOOTER, source.body(&head)?) else { return Ok(found) };
    let mut at = footer.summary_start;
    while at > 0
        && let Some(head) = source.head(at)?
        && source.fits(&head)
        && head.opcode != op::FOOTER
    {
        if [op::SCHEMA, op::CHANNEL].contains(&head.opcode) {
            match parse(head.opcode, source.body(&head)?) {
                Ok(Record::Schema { header, data }) => {
                    found.schemas.insert(header.id, (header.name, header.encoding, data.into()));
                }
                Ok(Record::Channel(channel)) => {
                    found.channels.insert(channel.id, channel);
                }
                _ => {}
            }
        }
        at = head.end();
    }
    Ok(found)
}

/// Holds the data of a closed file against its checksum. In the inner result, what differs; an index that is damaged is no loss.
fn check_sums(source: &mut RecordFile, path: &Path) -> Result<Result<(), String>, ReadError> {
    let limit = usize::try_from(source.length()).unwrap_or(usize::MAX);
    let options = LinearReaderOptions::default()
        .with_emit_chunks(true)
        .with_validate_data_section_crc(true)
        .with_record_length_limit(limit);
    let mut reader = LinearReader::new_with_options(options);
    let mut at = 0;
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let count = (wanted as u64).min(source.length() - at).min(1 << 20);
                if count > 0 {
                    let bytes = source.bytes(at, count)?;
                    reader.insert(bytes.len()).copy_from_slice(bytes);
                    at += count;
                }
                reader.notify_read(count as usize);
            }
            Ok(LinearReadEvent::Record { opcode: op::DATA_END, .. }) => return Ok(Ok(())),
            Ok(LinearReadEvent::Record { .. }) => {}
            Err(mcap::McapError::BadDataCrc { .. }) => {
                return Ok(Err(format!(
                    "the checksum of {} is wrong: something outside of its chunks has changed",
                    path.display()
                )));
            }
            Err(error) => return Ok(Err(error.to_string())),
        }
    }
    Ok(Ok(()))
}

/// Reads the new file back. Returns its size.
fn verify(out: &Path, expected: &Digest) -> Result<u64, RecoverError> {
    let differs = |cause: String| RecoverError::Verify { path: out.to_path_buf(), cause };
    let mut file = RecordFile::open(out)?;
    check_sums(&mut file, out)?.map_err(differs)?;
    let mut found = Digest::default();
    let mut counted = None;
    let mut at = mcap::MAGIC.len() as u64;
    let mut past_data_end = false;
    loop {
        let head = file.head(at)?.filter(|head| file.fits(head));
        let Some(head) = head else { return Err(differs("it has no end".to_owned())) };
        at = head.end();
        match head.opcode {
            op::CHUNK => {
                let chunk = file.chunk(&head)?.map_err(differs)?;
                let mut unpacker = Unpacker::whole(&mut file, &chunk)?.map_err(differs)?;
                while let Some(record) = unpacker.next(&mut file)? {
                    let (opcode, body) = record.map_err(differs)?;
                    if let Record::Message { header, data } = parse(opcode, &body).map_err(differs)? {
                        found.message(&header, &data);
                    }
                }
            }
            op::ATTACHMENT | op::METADATA | op::STATISTICS => match parse(head.opcode, file.body(&head)?) {
                Ok(Record::Attachment { header, data, .. }) => found.attachment(&header, &data),
                Ok(Record::Metadata(metadata)) => found.metadata(&metadata),
                Ok(Record::Statistics(statistics)) => counted = Some(statistics.message_count),
                Ok(_) => {}
                Err(cause) => return Err(differs(cause)),
            },
            op::DATA_END => past_data_end = true,
            op::FOOTER => break,
            _ => {}
        }
    }
    let messages: u64 = expected.messages.values().sum();
    if !past_data_end || counted != Some(messages) {
        return Err(differs(format!("its index counts {counted:?} messages, there are {messages}")));
    }
    let same = (&found.messages, found.attachments, found.metadata, found.hash.finish())
        == (&expected.messages, expected.attachments, expected.metadata, expected.hash.finish());
    if same { Ok(file.length()) } else { Err(differs("its content differs".to_owned())) }
}
