//! The records of an MCAP file one after the other, whatever the file is.
//!
//! In: a file. Out: heads and bodies of its records, those inside of chunks unpacked, or in words what is wrong with them. A
//! length is believed only as far as the file reaches, and checked before any memory is asked for; no bytes bring a panic
//! about. What the records mean is for [`messages`](crate::messages) and [`recover`](mod@crate::recover).
//!
//! ```text
//! magic  (opcode u8, length u64, body)..  magic          all numbers are little endian
//! body of a chunk: times, uncompressed size, checksum, name of the compression, compressed size, records
//! ```

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::ReadError;

/// Opcode and length.
const HEAD_BYTES: u64 = 9;

/// Largest record that is unpacked: 16384 x 16384 pixels of 4 bytes, and what is said of them.
const LONGEST_RECORD: u64 = (1 << 30) + (1 << 20);

/// No compression packs better than this: zstd, a block of 128 KiB in 4 bytes.
const BEST_COMPRESSION: u64 = 1 << 15;

/// Where a record lies in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Head {
    pub(crate) opcode: u8,
    /// Of the head.
    pub(crate) at: u64,
    /// Of the body, bytes.
    pub(crate) length: u64,
}

impl Head {
    pub(crate) fn body_at(&self) -> u64 {
        self.at + HEAD_BYTES
    }

    /// Where the next one begins; a length that is nonsense leads to the end of all files.
    pub(crate) fn end(&self) -> u64 {
        self.body_at().saturating_add(self.length)
    }
}

/// What a chunk says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Chunk {
    pub(crate) head: Head,
    /// Where its records begin.
    pub(crate) data_at: u64,
    pub(crate) uncompressed_size: u64,
    /// Checksum of the records; 0 if there is none.
    pub(crate) crc: u32,
    pub(crate) compressed_size: u64,
    /// `""`, `"lz4"`, `"zstd"`.
    pub(crate) compression: String,
}

/// A file that is read from anywhere.
pub(crate) struct RecordFile {
    path: PathBuf,
    file: BufReader<File>,
    at: u64,
    length: u64,
    buffer: Vec<u8>,
}

impl RecordFile {
    /// Opens a file that begins as MCAP files do.
    pub(crate) fn open(path: &Path) -> Result<Self, ReadError> {
        let io = |cause| ReadError::Io { path: path.to_path_buf(), cause };
        let file = File::open(path).map_err(io)?;
        let about = file.metadata().map_err(io)?;
        if !about.is_file() {
            let kind = if about.is_dir() { "a folder" } else { "no file of bytes" };
            return Err(ReadError::NoRecording { path: path.to_path_buf(), cause: format!("it is {kind}") });
        }
        let (file, buffer) = (BufReader::with_capacity(1 << 16, file), Vec::new());
        let mut file = Self { path: path.to_path_buf(), file, at: 0, length: about.len(), buffer };
        let magic = mcap::MAGIC.len() as u64;
        let begins = file.bytes(0, magic.min(file.length))?;
        if begins != mcap::MAGIC {
            let cause = match begins {
                [] => "it is empty".to_owned(),
                _ => format!("it begins with {:?}, not with the magic of MCAP", begins.escape_ascii().to_string()),
            };
            return Err(ReadError::NoRecording { path: path.to_path_buf(), cause });
        }
        Ok(file)
    }

    /// Of the file, bytes.
    pub(crate) fn length(&self) -> u64 {
        self.length
    }

    pub(crate) fn handle(&self) -> &File {
        self.file.get_ref()
    }

    fn error(&self, cause: io::Error) -> ReadError {
        ReadError::Io { path: self.path.clone(), cause }
    }

    fn go_to(&mut self, at: u64) -> Result<(), ReadError> {
        if at != self.at {
            // Within the buffer, if it can be.
            let there = match i64::try_from(i128::from(at) - i128::from(self.at)) {
                Ok(way) => self.file.seek_relative(way),
                Err(_) => self.file.seek(SeekFrom::Start(at)).map(drop),
            };
            there.map_err(|e| self.error(e))?;
            self.at = at;
        }
        Ok(())
    }

    /// So many bytes, which the caller knows to be there. If the file was cut meanwhile, that is an error of reading.
    pub(crate) fn bytes(&mut self, at: u64, count: u64) -> Result<&[u8], ReadError> {
        self.go_to(at)?;
        let mut buffer = std::mem::take(&mut self.buffer);
        buffer.resize(usize::try_from(count).unwrap_or(usize::MAX), 0);
        let read = self.file.read_exact(&mut buffer);
        self.buffer = buffer;
        match read {
            Ok(()) => self.at += count,
            Err(cause) => {
                // Where a read that failed has left the file is not known.
                self.at = u64::MAX;
                return Err(self.error(cause));
            }
        }
        Ok(&self.buffer)
    }

    /// The head at a place; none if too few bytes follow for one. The body may reach beyond the end of the file.
    pub(crate) fn head(&mut self, at: u64) -> Result<Option<Head>, ReadError> {
        if at.saturating_add(HEAD_BYTES) > self.length {
            return Ok(None);
        }
        let bytes = self.bytes(at, HEAD_BYTES)?;
        let (opcode, length) = (bytes[0], u64_at(bytes, 1));
        Ok(Some(Head { opcode, at, length }))
    }

    /// Whether the body lies in the file, and the opcode is one that MCAP has at this level.
    pub(crate) fn fits(&self, head: &Head) -> bool {
        let is_known = (op::SCHEMA..=op::DATA_END).contains(&head.opcode)
            || [op::HEADER, op::FOOTER].contains(&head.opcode)
            || head.opcode >= 0x80;
        is_known && head.end() <= self.length
    }

    pub(crate) fn body(&mut self, head: &Head) -> Result<&[u8], ReadError> {
        self.bytes(head.body_at(), head.length)
    }

    /// What a chunk says of itself; in the inner result, why that cannot be. Its records may reach beyond the end of the file.
    pub(crate) fn chunk(&mut self, head: &Head) -> Result<Result<Chunk, String>, ReadError> {
        // Two times, size, checksum, length of a name; and a second size behind the name.
        const FIXED: u64 = 8 + 8 + 8 + 4 + 4;
        let there = self.length.saturating_sub(head.body_at()).min(head.length);
        let cut = || "it ends before its first record".to_owned();
        if there < FIXED + 8 {
            return Ok(Err(cut()));
        }
        let bytes = self.bytes(head.body_at(), FIXED)?;
        let (uncompressed_size, crc, name_bytes) = (u64_at(bytes, 16), u32_at(bytes, 24), u64::from(u32_at(bytes, 28)));
        if name_bytes > 32 {
            return Ok(Err(format!("the name of its compression has {name_bytes} bytes")));
        }
        if there < FIXED + name_bytes + 8 {
            return Ok(Err(cut()));
        }
        let bytes = self.bytes(head.body_at() + FIXED, name_bytes + 8)?;
        let (name, size) = bytes.split_at(name_bytes as usize);
        let compression = match name {
            b"" | b"lz4" | b"zstd" => String::from_utf8_lossy(name).into_owned(),
            other => return Ok(Err(format!("its compression {:?} is not known", other.escape_ascii().to_string()))),
        };
        let compressed_size = u64_at(size, 0);
        let data_at = head.body_at() + FIXED + name_bytes + 8;
        Ok(Ok(Chunk { head: *head, data_at, uncompressed_size, crc, compressed_size, compression }))
    }

    /// The head of a chunk whose length does not lead to a record while the size of its records does: one of the two is damaged.
    pub(crate) fn repaired(&mut self, head: Head) -> Result<Head, ReadError> {
        if head.opcode != op::CHUNK {
            return Ok(head);
        }
        let Ok(chunk) = self.chunk(&head)? else { return Ok(head) };
        let end = chunk.data_at.saturating_add(chunk.compressed_size);
        let by_size = Head { length: end - head.body_at(), ..head };
        let is_better = end != head.end()
            && self.fits(&by_size)
            && self.is_followed(&by_size)?
            && !(self.fits(&head) && self.is_followed(&head)?);
        Ok(if is_better { by_size } else { head })
    }

    /// Where the next record may lie, from a place on where there is none: the first from which on bytes are as those of a
    /// record must be. None if there is none up to the end.
    pub(crate) fn next_record(&mut self, from: u64) -> Result<Option<u64>, ReadError> {
        const WINDOW: u64 = 1 << 16;
        let mut at = from;
        while at.saturating_add(HEAD_BYTES) <= self.length {
            let count = WINDOW.min(self.length - at);
            let window = self.bytes(at, count)?.to_vec();
            for (i, bytes) in window.windows(HEAD_BYTES as usize).enumerate() {
                let head = Head { opcode: bytes[0], at: at + i as u64, length: u64_at(bytes, 1) };
                if self.fits(&head) && self.looks_like_a_record(&head)? {
                    return Ok(Some(head.at));
                }
            }
            at += count - (HEAD_BYTES - 1).min(count - 1);
        }
        Ok(None)
    }

    /// Whether a head that fits is followed by what must follow it: by chance that happens as good as never.
    fn looks_like_a_record(&mut self, head: &Head) -> Result<bool, ReadError> {
        match head.opcode {
            op::CHUNK => {
                let chunk = self.chunk(head)?;
                Ok(chunk.is_ok_and(|chunk| chunk.data_at.checked_add(chunk.compressed_size) == Some(head.end())))
            }
            op::MESSAGE_INDEX => {
                if head.length < 6 + 16 {
                    return Ok(false);
                }
                let entries = u64::from(u32_at(self.bytes(head.body_at(), 6)?, 2));
                Ok(head.length == 6 + entries && entries % 16 == 0)
            }
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::ATTACHMENT | op::METADATA => {
                Ok(parse(head.opcode, self.body(head)?).is_ok() && self.is_followed(head)?)
            }
            op::DATA_END => Ok(head.length == 4 && self.is_followed(head)?),
            _ => Ok(false),
        }
    }

    /// Whether a record ends where another begins, or the file ends.
    pub(crate) fn is_followed(&mut self, head: &Head) -> Result<bool, ReadError> {
        let next = self.head(head.end())?;
        Ok(head.end() == self.length || next.is_some_and(|next| self.fits(&next)))
    }
}

/// A record from inside of a chunk: opcode and body.
pub(crate) type Unpacked = (u8, Vec<u8>);

/// The records inside of a chunk, one after the other.
pub(crate) struct Unpacker {
    reader: LinearReader,
    at: u64,
    end: u64,
}

impl Unpacker {
    /// Of a chunk that lies in the file as a whole. In the inner result, why it cannot be unpacked.
    pub(crate) fn whole(file: &mut RecordFile, chunk: &Chunk) -> Result<Result<Self, String>, ReadError> {
        if chunk.data_at.saturating_add(chunk.compressed_size) > chunk.head.end() {
            return Ok(Err("its records are longer than itself".to_owned()));
        }
        let end = chunk.data_at + chunk.compressed_size;
        // The library trusts the lengths in chunks that are not compressed.
        if chunk.compression.is_empty() && last_whole_record(file, chunk.data_at, end)? != end {
            return Ok(Err("a record in it reaches beyond its end".to_owned()));
        }
        Ok(Ok(Self::new(chunk, end)))
    }

    /// Of a chunk at whose end the file was cut off: whole records until there are none any more, which is told as an error.
    pub(crate) fn cut_off(file: &mut RecordFile, chunk: &Chunk) -> Result<Self, ReadError> {
        // Nothing is known of the size, and no checksum can be right.
        if chunk.compression.is_empty() {
            let end = last_whole_record(file, chunk.data_at, file.length)?;
            return Ok(Self::new(&Chunk { crc: 0, uncompressed_size: end - chunk.data_at, ..chunk.clone() }, end));
        }
        Ok(Self::new(&Chunk { crc: 0, uncompressed_size: u64::MAX, ..chunk.clone() }, file.length))
    }

    /// With a head that promises no more than there is.
    fn new(chunk: &Chunk, end: u64) -> Self {
        let (name, size) = (chunk.compression.as_bytes(), end.saturating_sub(chunk.data_at));
        let mut head = vec![op::CHUNK];
        head.extend((40 + name.len() as u64 + size).to_le_bytes());
        // The times are of no interest here.
        head.extend([0; 16]);
        head.extend(chunk.uncompressed_size.to_le_bytes());
        head.extend(chunk.crc.to_le_bytes());
        head.extend((name.len() as u32).to_le_bytes());
        head.extend(name);
        head.extend(size.to_le_bytes());
        let mut reader = reader(size, chunk.uncompressed_size);
        reader.insert(head.len()).copy_from_slice(&head);
        reader.notify_read(head.len());
        Self { reader, at: chunk.data_at, end }
    }

    /// The next record, opcode and body; `None` behind the last one, after the checksum was found right. In the inner result, what
    /// is wrong.
    pub(crate) fn next(&mut self, file: &mut RecordFile) -> Result<Option<Result<Unpacked, String>>, ReadError> {
        loop {
            let wanted = match self.reader.next_event() {
                None => return Ok(None),
                Some(Err(error)) => return Ok(Some(Err(error.to_string()))),
                Some(Ok(LinearReadEvent::Record { opcode, data })) => return Ok(Some(Ok((opcode, data.to_vec())))),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => wanted,
            };
            let count = (wanted as u64).min(self.end - self.at).min(1 << 20);
            if count > 0 {
                let bytes = file.bytes(self.at, count)?;
                self.reader.insert(bytes.len()).copy_from_slice(bytes);
                self.at += count;
            }
            // Zero is the end.
            self.reader.notify_read(count as usize);
        }
    }
}

fn reader(compressed_size: u64, uncompressed_size: u64) -> LinearReader {
    let most = uncompressed_size.min(compressed_size.saturating_mul(BEST_COMPRESSION));
    let limit = most.max(compressed_size).clamp(1 << 16, LONGEST_RECORD);
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(usize::try_from(limit).unwrap_or(usize::MAX));
    LinearReader::new_with_options(options)
}

/// Where the last of the records ends that lie between two places as a whole.
fn last_whole_record(file: &mut RecordFile, from: u64, end: u64) -> Result<u64, ReadError> {
    let mut at = from;
    while at < end {
        match file.head(at)? {
            Some(head) if head.end() <= end => at = head.end(),
            _ => break,
        }
    }
    Ok(at)
}

/// What a record says, if it is one that this crate reads. The library takes lengths for granted: it asks for as much memory as a
/// name claims to take, and for an attachment with room for its checksum.
pub(crate) fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, String> {
    match opcode {
        op::CHUNK | op::CHUNK_INDEX | op::ATTACHMENT_INDEX | op::METADATA_INDEX | op::SUMMARY_OFFSET => {
            return Err("a record that does not belong here".to_owned());
        }
        _ if !lengths_fit(opcode, body) => return Err("something in the record is longer than itself".to_owned()),
        _ => {}
    }
    mcap::parse_record(opcode, body).map_err(|e| e.to_string())
}

/// Whether the names in a record, and what follows them, are no longer than the record.
fn lengths_fit(opcode: u8, body: &[u8]) -> bool {
    let (fixed, names, has_map, rest) = match opcode {
        op::HEADER => (0, 2, false, 0),
        op::SCHEMA => (2, 2, false, 4),
        op::CHANNEL => (4, 2, true, 0),
        op::METADATA => (0, 1, true, 0),
        // A length and a checksum.
        op::ATTACHMENT => (16, 2, false, 8 + 4),
        _ => return true,
    };
    let after_name = |at: usize| {
        let end = at + 4 + u32_at(body.get(at..at + 4)?, 0) as usize;
        (end <= body.len()).then_some(end)
    };
    let end = (0..names).try_fold(fixed, |at, _| after_name(at));
    let Some(mut at) = end else { return false };
    if has_map {
        let Some(length) = body.get(at..at + 4) else { return false };
        let start = at + 4;
        let length = u32_at(length, 0) as usize;
        at = start;
        while at - start < length {
            match after_name(at).and_then(after_name) {
                Some(next) => at = next,
                None => return false,
            }
        }
    }
    at + rest <= body.len()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |bytes| u64::from_le_bytes(*bytes))
}
