//! One connection to an emulated controller, served by a thread of its own.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::Ordering;
use std::time::Duration;

use super::journal::{CommandResult, JournalEntry};
use super::machine::Answer;
use super::request::{Incoming, RequestParser};
use super::script::{FaultKind, FaultPhase, FaultRule};
use super::{Shared, lock, reachable};
use crate::motoman::command::{LinearSpeed, Place, Request, Terminator};

/// The connection ends here.
enum Ended {
    /// What was sent still arrives.
    Orderly,
    /// With a reset.
    Reset,
}

/// How a reply is to be spoilt.
#[derive(Default)]
struct Spoilt {
    by: Vec<FaultKind>,
}

impl Spoilt {
    fn is(&self, kind: FaultKind) -> bool {
        self.by.contains(&kind)
    }
}

/// Serves one connection to its end.
pub(super) fn serve(shared: &Shared, stream: &TcpStream, number: u64) {
    // Replies are to leave as they are written, not when there is more to send.
    if stream.set_nodelay(true).is_err() {
        return;
    }
    let second_client = stream.peer_addr().is_ok_and(|peer| lock(&shared.second_clients).contains(&peer.port()));
    let mut connection = Connection {
        shared,
        stream,
        number,
        second_client,
        parser: RequestParser::new(),
        incoming: VecDeque::new(),
        failed: false,
    };
    if !matches!(connection.serve(), Err(Ended::Reset)) {
        // It may have been closed by the host.
        let _ = stream.shutdown(Shutdown::Both);
    }
}

struct Connection<'a> {
    shared: &'a Shared,
    stream: &'a TcpStream,
    number: u64,
    second_client: bool,
    parser: RequestParser,
    incoming: VecDeque<Incoming>,
    /// Behind what has come in lies something that is no request.
    failed: bool,
}

impl Connection<'_> {
    fn serve(&mut self) -> Result<(), Ended> {
        let config = &self.shared.config;
        let Incoming::Start { keep_alive } = self.next("HTTP Error Response")? else {
            return Err(Ended::Orderly);
        };
        let greeting = format!("OK: {} Keep-Alive:{keep_alive}.", config.product);
        self.write(&self.line(&greeting, true), &Spoilt::default())?;
        let mut served = 0;
        while keep_alive < 0 || served < keep_alive {
            let Incoming::Header { command, size } = self.next("HOSTCTRL_REQUEST is not correct")? else {
                return Err(Ended::Orderly);
            };
            self.shared.in_progress.fetch_add(1, Ordering::SeqCst);
            let number = self.enter(&command);
            let result = self.command(&command, size, number);
            self.shared.in_progress.fetch_sub(1, Ordering::SeqCst);
            lock(&self.shared.journal).close(number);
            result?;
            served += 1;
        }
        Ok(())
    }

    fn command(&mut self, command: &str, size: usize, number: usize) -> Result<(), Ended> {
        let (rules, pending) = if self.second_client {
            (Vec::new(), None)
        } else {
            let mut machine = lock(&self.shared.machine);
            machine.update();
            (lock(&self.shared.script).take(command), machine.pending.take())
        };
        self.amend(number, |entry| entry.faults.clone_from(&rules));
        let at = |phase| rules.iter().filter(move |rule| rule.phase == phase).map(|rule: &FaultRule| rule.what);

        let header_faults: Vec<FaultKind> = pending.into_iter().chain(at(FaultPhase::Header)).collect();
        let mut spoilt = Spoilt::default();
        self.suffer(&header_faults, &mut spoilt)?;
        let accepted = self.line(&format!("OK: {command}"), true);
        let coalesce = size == 0 && (self.shared.config.coalesce || spoilt.is(FaultKind::Coalesce));
        if !coalesce {
            self.write(&accepted, &spoilt)?;
        }
        let data = if size > 0 {
            let Incoming::Data(data) = self.next("no data")? else {
                return Err(Ended::Orderly);
            };
            data
        } else {
            Vec::new()
        };
        let text = String::from_utf8_lossy(&data).into_owned();
        self.amend(number, |entry| {
            entry.result = CommandResult::Received;
            entry.data = (size > 0).then(|| text.trim_end_matches(['\r', '\n']).to_string());
        });

        let mut spoilt = Spoilt::default();
        self.suffer(&at(FaultPhase::Data).collect::<Vec<_>>(), &mut spoilt)?;
        let mid = rules.iter().find(|rule| rule.phase == FaultPhase::MidMotion).map(|rule| (rule.share, rule.what));
        let answer = {
            let mut machine = lock(&self.shared.machine);
            let executed = match text.strip_suffix("\r\n").or_else(|| text.strip_suffix('\r')) {
                Some(data) => machine.execute(command, data, mid),
                None if size == 0 => machine.execute(command, "", mid),
                // The size must count the end of the line.
                None => Err(1013),
            };
            let (line, with_lf) = match &executed {
                Ok(Answer::Done) => ("0000".to_string(), true),
                // An answer with data ends in CR only.
                Ok(Answer::Data(data)) => (data.clone(), false),
                Err(code) => (format!("ERROR: {command} is not successful({code:04})."), true),
            };
            // While the machine is locked: who sees the motion finds it in the journal.
            self.amend(number, |entry| {
                entry.result = match executed {
                    Ok(_) => CommandResult::Executed { answer: line.clone() },
                    Err(code) => CommandResult::Refused { code },
                };
            });
            self.line(&line, with_lf)
        };
        self.suffer(&at(FaultPhase::Answer).collect::<Vec<_>>(), &mut spoilt)?;
        if coalesce {
            return self.write(&[accepted, answer].concat(), &spoilt);
        }
        self.write(&answer, &spoilt)
    }

    /// Lets faults happen. What only spoils the next reply is added to `spoilt`.
    fn suffer(&mut self, faults: &[FaultKind], spoilt: &mut Spoilt) -> Result<(), Ended> {
        for fault in faults {
            match fault {
                FaultKind::Close => return Err(Ended::Orderly),
                FaultKind::Reset => return self.reset(),
                FaultKind::Delay { ms } => {
                    if !self.shared.wait(Duration::from_millis(*ms)) {
                        return Err(Ended::Orderly);
                    }
                }
                FaultKind::NeverAnswer => return self.fall_silent(),
                FaultKind::OneByteSegments
                | FaultKind::Coalesce
                | FaultKind::Twice
                | FaultKind::LoneCr
                | FaultKind::Truncate
                | FaultKind::NonAscii
                | FaultKind::TooLong => spoilt.by.push(*fault),
                FaultKind::SecondClient => {
                    // It may be refused; what it did is in the journal.
                    let _ = self.second_client_moves();
                }
                robot => {
                    let mut machine = lock(&self.shared.machine);
                    machine.update();
                    machine.suffer(*robot);
                }
            }
        }
        Ok(())
    }

    fn reset(&self) -> Result<(), Ended> {
        // Without time to linger a close is a reset.
        let _ = rustix::net::sockopt::set_socket_linger(self.stream, Some(Duration::ZERO));
        Err(Ended::Reset)
    }

    /// Reads on without a word until the host gives up.
    fn fall_silent(&mut self) -> Result<(), Ended> {
        let mut buffer = [0; 1024];
        while matches!((&*self.stream).read(&mut buffer), Ok(count) if count > 0) {}
        Err(Ended::Orderly)
    }

    fn second_client_moves(&self) -> std::io::Result<()> {
        let mut ports = lock(&self.shared.second_clients);
        let mut stream = TcpStream::connect_timeout(&reachable(self.shared.address), Duration::from_secs(1))?;
        ports.insert(stream.local_addr()?.port());
        drop(ports);
        stream.set_read_timeout(Some(Duration::from_secs(1)))?;
        let mut pose = lock(&self.shared.machine).update();
        pose.z_mm += 20.0;
        let speed = LinearSpeed::MillimetresPerSecond(50.0);
        let place = Place { coordinate_system: 0, pose, figure: 0, tool: 0 };
        let motion = Request::MoveLinear { speed, to: place }.encode(Terminator::Cr).map_err(std::io::Error::other)?;
        let data = motion.data.unwrap_or_default();
        for line in [&b"CONNECT Robot_access Keep-Alive:2\r\n"[..], &motion.header, &data] {
            stream.write_all(line)?;
            let mut byte = [0];
            while byte != *b"\n" {
                stream.read_exact(&mut byte)?;
            }
        }
        Ok(())
    }

    /// Puts a command into the journal.
    fn enter(&self, command: &str) -> usize {
        let time_ms = lock(&self.shared.machine).now().as_secs_f64() * 1000.0;
        let mut journal = lock(&self.shared.journal);
        let number = journal.entries.len();
        journal.entries.push(JournalEntry {
            number,
            time_ms,
            connection: self.number,
            second_client: self.second_client,
            command: command.to_string(),
            data: None,
            result: CommandResult::HeaderOnly,
            faults: Vec::new(),
        });
        number
    }

    fn amend(&self, number: usize, change: impl FnOnce(&mut JournalEntry)) {
        if let Some(entry) = lock(&self.shared.journal).entries.get_mut(number) {
            change(entry);
        }
    }

    /// What comes next from the host. What is no request is answered with `NG:` and `message`.
    fn next(&mut self, message: &str) -> Result<Incoming, Ended> {
        let mut buffer = [0; 1024];
        loop {
            if let Some(incoming) = self.incoming.pop_front() {
                return Ok(incoming);
            }
            if self.failed {
                self.write(&self.line(&format!("NG: {message}"), true), &Spoilt::default())?;
                return Err(Ended::Orderly);
            }
            let count = match (&*self.stream).read(&mut buffer) {
                Ok(count) if count > 0 => count,
                _ => return Err(Ended::Orderly),
            };
            let mut parts = Vec::new();
            self.failed = self.parser.feed(&buffer[..count], &mut parts).is_err();
            self.incoming.extend(parts);
        }
    }

    fn line(&self, text: &str, with_lf: bool) -> Vec<u8> {
        let end = if with_lf && !self.shared.config.lone_cr { "\r\n" } else { "\r" };
        format!("{text}{end}").into_bytes()
    }

    fn write(&self, reply: &[u8], spoilt: &Spoilt) -> Result<(), Ended> {
        let mut reply = reply.to_vec();
        if spoilt.is(FaultKind::LoneCr) {
            reply.retain(|byte| *byte != b'\n');
        }
        if spoilt.is(FaultKind::Twice) {
            reply.extend(reply.clone());
        }
        if spoilt.is(FaultKind::NonAscii) {
            reply.insert(reply.len() / 2, 0xc3);
        }
        if spoilt.is(FaultKind::TooLong) {
            reply = vec![b'7'; 2 * crate::motoman::reply::LINE_MAX];
        }
        if spoilt.is(FaultKind::Truncate) {
            reply.truncate(reply.len() / 2);
        }
        let mut stream = self.stream;
        let written = if spoilt.is(FaultKind::OneByteSegments) {
            reply.chunks(1).try_for_each(|byte| stream.write_all(byte))
        } else {
            stream.write_all(&reply)
        };
        if written.is_err() || spoilt.is(FaultKind::Truncate) {
            return Err(Ended::Orderly);
        }
        Ok(())
    }
}
