//! What an emulated controller was told, and what came of it.

use std::fs::File;
use std::io::Write;

use serde::Serialize;

/// One command, in the order in which headers came in.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JournalEntry {
    /// Number of the entry, from 0.
    pub number: usize,
    /// When its header came, on the clock of the emulator, ms.
    pub time_ms: f64,
    /// Number of the connection, from 1.
    pub connection: u64,
    /// It came from the second client of a [fault](super::FaultKind::SecondClient).
    pub second_client: bool,
    /// Name of the command.
    pub command: String,
    /// Its data without their end, if they came.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data: Option<String>,
    /// What came of it.
    pub result: CommandResult,
    /// Faults that happened on the way.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub faults: Vec<super::FaultRule>,
}

/// What came of a command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "result", rename_all = "snake_case")]
pub enum CommandResult {
    /// The header came, and the rest has not come yet or never did.
    HeaderOnly,
    /// All of it came, and it is not executed yet or never was.
    Received,
    /// It was refused.
    Refused {
        /// Interpreter message.
        code: u32,
    },
    /// It was executed, or a motion begun, whether or not the host got to know.
    Executed {
        /// The answer as it was to be sent.
        answer: String,
    },
}

#[derive(Default)]
pub(super) struct Journal {
    pub(super) entries: Vec<JournalEntry>,
    file: Option<File>,
}

impl Journal {
    pub(super) fn new(file: Option<File>) -> Self {
        Self { entries: Vec::new(), file }
    }

    /// The command has come to its end: writes its line.
    pub(super) fn close(&mut self, number: usize) {
        let (Some(file), Some(entry)) = (&mut self.file, self.entries.get(number)) else { return };
        let written =
            serde_json::to_string(entry).map_err(std::io::Error::from).and_then(|line| writeln!(file, "{line}"));
        if written.is_err() {
            // A full disk must not stop the emulated robot; what is in memory stays complete.
            self.file = None;
        }
    }
}
