//! Yaskawa Motoman controllers (DX, FS, YRC) over their "Ethernet Server", the host control on TCP port 80.
//!
//! [`Motoman`] is the controller; the layers below it can be used and tested by themselves:
//!
//! ```text
//! Motoman                 what is known of the last command; readiness, latched faults, reconnecting
//! tcp                     reads and writes with deadlines, every byte recorded before it leaves
//! session   (no I/O)      header, data, answer; what is known when the conversation breaks
//! command, reply (no I/O) requests as bytes, bytes as replies
//! ```
//!
//! # Two ways to give a motion
//!
//! With `mode = "direct"` a motion is one command, MOVJ or MOVL. With `mode = "job"` it is a taught INFORM job: the
//! target is written to a P variable, the speed to an I variable (0.1 mm/s, or 0.01 %), the kind to a B variable (1
//! joint, 2 linear), and then the job is started. Cells that must pass interlocks, or whose safety concept allows host
//! commands only to start jobs, use it. The job reads the three variables, makes the one motion and ends; in INFORM:
//!
//! ```text
//! NOP
//! JUMP *LINEAR IF B012=2
//! MOVJ P010 VJ=I011
//! JUMP *END
//! *LINEAR
//! MOVL P010 V=I011
//! *END
//! END
//! ```
//!
//! Both ways are one trait to the caller: only START moves anything, so a connection that breaks while variables are
//! written leaves the motion not executed, and one that breaks after START leaves it unknown. While the job runs, RJSEQ
//! tells whether it is still ours, so the job must not call others. The gripper works by network inputs (IOWRITE) or by
//! jobs in either mode.
//!
//! # What is concluded from what
//!
//! The host control has no number for a command: whether a motion has ended is concluded from RSTATS and RPOSC, read in
//! this order so that a robot that stands is asked for its place after it stood. It has no bit for the emergency stop
//! either; if the controller is set up to show one as an output, `emergency_stop` names it, otherwise servo power off is
//! all that can be said. Poses are in the coordinate system and for the tool of the configuration.
//!
//! # After a break
//!
//! Nothing reconnects behind the caller's back, except after the last command of a connection that was to serve only so
//! many. [`Controller::connect`] is one attempt; after one that failed, further ones are refused for 0.25 s, doubling up
//! to 5 s. No command is ever sent a second time.

mod back_off;
pub mod command;
mod config;
mod interpreter_message;
pub mod reply;
pub mod session;
mod tcp;

use std::sync::Arc;
use std::time::Duration;

use back_off::BackOff;
use command::{
    JobReply, LinearSpeed, Place, PlaceReply, Request, RequestError, SPEED_ABOVE, StatusBits, Value, read_alarm,
    read_bytes,
};
pub use config::{GripperConfig, JobConfig, Mode, MotomanConfig, MotomanConfigError, Signal};
pub use interpreter_message::meaning;
use session::{Answer, Broken, Known};
use tcp::Link;

use crate::wire_log::Unconditional;
use crate::{
    AbortReason, Clock, CommandId, ConnectError, Controller, GripperCommand, GripperError, GripperState, HoldError,
    Motion, MotionError, NotReady, Outcome, PollError, Pose, PositionError, Progress, ResumeError, RobotState, Status,
    StatusError, WireLog,
};

/// A Motoman controller; see the module documentation.
pub struct Motoman {
    config: MotomanConfig,
    clock: Arc<dyn Clock>,
    log: Box<dyn WireLog>,
    link: Option<Link>,
    /// This connection has served a command.
    served: bool,
    /// The last connection broke before it had served one.
    broke_unserved: bool,
    back_off: BackOff,
    last: Option<Last>,
    latched: Option<String>,
    /// The robot was ready once: what it loses from then on is a fault, and not how it was found.
    seen_ready: bool,
    gripper: GripperState,
}

/// The last command that was given to the controller.
struct Last {
    id: CommandId,
    outcome: Outcome,
    what: Doing,
    /// When it was accepted, on the clock.
    began: Duration,
    /// The controller was seen running it.
    ran: bool,
    /// It was put on hold by command.
    held: bool,
}

#[derive(Clone)]
enum Doing {
    Motion { target: Pose, job: Option<String> },
    Gripper { ends: GripperState, job: bool },
}

/// Why a command has no answer that it should have.
enum Failure {
    NotConnected,
    Request(RequestError),
    Broken(Broken),
    Refused(u32),
}

impl Failure {
    fn cause(&self) -> String {
        match self {
            Self::NotConnected => "not connected".into(),
            Self::Request(error) => error.to_string(),
            Self::Broken(broken) => broken.to_string(),
            Self::Refused(code) => format!("the controller refused: {code} ({})", meaning(*code)),
        }
    }
}

/// Why no command can be given.
enum NotNow {
    NotRead { cause: String },
    NotReady(NotReady),
}

impl From<StatusError> for NotNow {
    fn from(error: StatusError) -> Self {
        Self::NotRead { cause: error.to_string() }
    }
}

impl From<PositionError> for NotNow {
    fn from(error: PositionError) -> Self {
        Self::NotRead { cause: error.to_string() }
    }
}

impl From<NotReady> for NotNow {
    fn from(reason: NotReady) -> Self {
        Self::NotReady(reason)
    }
}

impl From<NotNow> for MotionError {
    fn from(reason: NotNow) -> Self {
        match reason {
            NotNow::NotRead { cause } => Self::NotSent { cause },
            NotNow::NotReady(reason) => Self::NotReady(reason),
        }
    }
}

impl From<NotNow> for GripperError {
    fn from(reason: NotNow) -> Self {
        match reason {
            NotNow::NotRead { cause } => Self::NotSent { cause },
            NotNow::NotReady(reason) => Self::NotReady(reason),
        }
    }
}

/// Why a command that acts was not accepted.
enum Rejection {
    Refused { code: u32, meaning: String },
    NotSent { cause: String },
    NoAnswer { cause: String },
}

impl From<Rejection> for MotionError {
    fn from(rejection: Rejection) -> Self {
        match rejection {
            Rejection::Refused { code, meaning } => Self::Refused { code, meaning },
            Rejection::NotSent { cause } => Self::NotSent { cause },
            Rejection::NoAnswer { cause } => Self::NoAnswer { cause },
        }
    }
}

impl From<Rejection> for GripperError {
    fn from(rejection: Rejection) -> Self {
        match rejection {
            Rejection::Refused { code, meaning } => Self::Refused { code, meaning },
            Rejection::NotSent { cause } => Self::NotSent { cause },
            Rejection::NoAnswer { cause } => Self::NoAnswer { cause },
        }
    }
}

impl Motoman {
    /// A controller that is not connected yet. `clock` paces the gripper and the waits between attempts to connect;
    /// deadlines of the network are in real time. Every byte goes through `log` before it leaves.
    ///
    /// # Errors
    /// [`MotomanConfigError`] names the key whose value is not allowed.
    pub fn new(
        config: MotomanConfig,
        clock: impl Clock + 'static,
        log: Box<dyn WireLog>,
    ) -> Result<Self, MotomanConfigError> {
        config.check()?;
        let [least, most] = [config.reconnect_least_ms, config.reconnect_most_ms].map(Duration::from_millis);
        Ok(Self {
            config,
            clock: Arc::new(clock),
            log,
            link: None,
            served: false,
            broke_unserved: false,
            back_off: BackOff::new(least, most),
            last: None,
            latched: None,
            seen_ready: false,
            gripper: GripperState::Unknown,
        })
    }

    /// The configuration in force.
    pub fn config(&self) -> &MotomanConfig {
        &self.config
    }

    fn open(&mut self) -> Result<(), ConnectError> {
        self.link = None;
        let remaining = self.back_off.remaining(self.clock.now());
        if !remaining.is_zero() {
            let address = self.config.host_and_port();
            return Err(ConnectError::BackingOff { address, wait_ms: remaining.as_millis().max(1) as u64 });
        }
        match Link::open(&self.config, &mut *self.log) {
            Ok(link) => {
                (self.link, self.served) = (Some(link), false);
                Ok(())
            }
            Err(error) => {
                self.back_off.failed(self.clock.now());
                Err(error)
            }
        }
    }

    fn is_connected(&self) -> bool {
        self.link.as_ref().is_some_and(|link| link.is_open() || link.is_spent())
    }

    fn exchange(&mut self, request: &Request) -> Result<Answer, Failure> {
        let encoded = request.encode(self.config.data_terminator).map_err(Failure::Request)?;
        if self.link.as_ref().is_some_and(Link::is_spent) {
            // As agreed at the greeting: nothing is in flight, and nothing was lost.
            self.open().map_err(|error| {
                let cause = session::BreakCause::Io { cause: error.to_string() };
                Failure::Broken(Broken { cause, ..tcp::not_open() })
            })?;
        }
        let link = self.link.as_mut().ok_or(Failure::NotConnected)?;
        let exchanged = match request {
            Request::Hold { on: true } => link.exchange(encoded, &mut Unconditional(&mut *self.log)),
            _ => link.exchange(encoded, &mut *self.log),
        };
        match exchanged {
            Ok(answer) => {
                (self.served, self.broke_unserved) = (true, false);
                self.back_off.served();
                match answer {
                    Answer::Refused { code } => Err(Failure::Refused(code)),
                    answer => Ok(answer),
                }
            }
            Err(broken) => {
                self.link = None;
                // One that greets and then breaks may be bad luck; two in a row are called as one that does not answer.
                if !self.served && std::mem::replace(&mut self.broke_unserved, true) {
                    self.back_off.failed(self.clock.now());
                }
                Err(Failure::Broken(broken))
            }
        }
    }

    /// A request that only reads: its data line.
    fn read(&mut self, request: &Request) -> Result<String, StatusError> {
        match self.exchange(request) {
            Ok(Answer::Data(line)) => Ok(line),
            Ok(_) => Err(StatusError::Malformed { answer: "0000".into() }),
            Err(Failure::NotConnected) => Err(StatusError::NotConnected),
            Err(failure) => Err(StatusError::NoAnswer { cause: failure.cause() }),
        }
    }

    fn read_signal(&mut self, signal: Signal) -> Result<bool, StatusError> {
        let line = self.read(&Request::ReadIo { start_address: signal.start_address, bytes: 1 })?;
        let bytes = read_bytes(&line, 1).map_err(|e| StatusError::Malformed { answer: e.answer })?;
        Ok((bytes[0] >> signal.bit & 1 == 1) != signal.inverted)
    }

    /// Reads the status, concludes a gripper command from it, and latches what was lost. Tells also whether the
    /// controller itself is running something.
    fn read_status(&mut self) -> Result<(Status, bool), StatusError> {
        let malformed = |e: command::AnswerError| StatusError::Malformed { answer: e.answer };
        let bits = StatusBits::parse(&self.read(&Request::ReadStatus)?).map_err(malformed)?;
        let alarm = if bits.alarm || bits.error {
            // It stands whatever its code.
            Some(read_alarm(&self.read(&Request::ReadAlarm)?).map_err(malformed)?.unwrap_or(0))
        } else {
            None
        };
        let emergency_stop = match self.config.emergency_stop {
            Some(signal) if !bits.servo_on => self.read_signal(signal)?,
            _ => false,
        };
        let mut status = Status {
            remote: bits.command_remote,
            play: bits.play && !bits.teach,
            servo_on: bits.servo_on,
            running: bits.running,
            hold_command: bits.hold_command,
            hold_external: bits.hold_external,
            hold_pendant: bits.hold_pendant,
            emergency_stop,
            alarm,
            latched: None,
            gripper: self.gripper,
        };
        self.conclude_gripper(&status);
        if let Some(signal) = self.config.part_sensor
            && matches!(self.gripper, GripperState::Closed | GripperState::Holding | GripperState::Empty)
        {
            self.gripper = if self.read_signal(signal)? { GripperState::Holding } else { GripperState::Empty };
        }
        match lost(&status) {
            Some(reason) if self.seen_ready => self.latch(&reason.to_string()),
            Some(_) => {}
            None => self.seen_ready = true,
        }
        status.gripper = self.gripper;
        status.running |= self.gripper == GripperState::Moving;
        status.latched = self.latched.clone();
        Ok((status, bits.running))
    }

    fn read_place(&mut self) -> Result<PlaceReply, PositionError> {
        let request = Request::ReadPlace { coordinate_system: self.config.coordinate_system };
        let line = self.read(&request).map_err(|error| match error {
            StatusError::NotConnected => PositionError::NotConnected,
            StatusError::NoAnswer { cause } => PositionError::NoAnswer { cause },
            StatusError::Malformed { answer } => PositionError::Malformed { answer },
        })?;
        PlaceReply::parse(&line).map_err(|e| PositionError::Malformed { answer: e.answer })
    }

    /// Reads whether a command may be given. A motion that nobody has followed to its end is concluded first: the robot
    /// may not have begun it yet, or may have been stopped on its way and put right since.
    fn check_ready(&mut self) -> Result<(), NotNow> {
        let (status, running) = self.read_status()?;
        status.check_ready()?;
        if self.is_moving() {
            let at = self.read_place()?.pose;
            self.conclude_motion(&status, running, &at)?;
            if let Some(reason) = self.latched.clone() {
                return Err(NotReady::Latched { reason }.into());
            }
            if self.is_moving() {
                return Err(NotReady::Running.into());
            }
        }
        Ok(())
    }

    /// Whether a motion was accepted and its end is not known.
    fn is_moving(&self) -> bool {
        matches!(&self.last, Some(Last { outcome: Outcome::Accepted, what: Doing::Motion { .. }, .. }))
    }

    fn check_fresh(&self, id: CommandId) -> Result<(), CommandId> {
        match &self.last {
            Some(last) if id <= last.id => Err(last.id),
            _ => Ok(()),
        }
    }

    /// Checks the speed, and gives it as the I variable of a job holds it.
    fn check_speed(&self, motion: &Motion) -> Result<i16, MotionError> {
        let (value, scale, at_most, unit) = match motion {
            Motion::Joint { speed_fraction, .. } => (*speed_fraction, 1e4, 1.0, "of the greatest speed"),
            Motion::Linear { speed_mm_s, .. } => (*speed_mm_s, 10.0, self.config.linear_speed_max_mm_s, "mm/s"),
        };
        // What would be written as zero is refused.
        let above = match (self.config.mode, motion) {
            (Mode::Job, _) => 0.5 / scale,
            (Mode::Direct, Motion::Joint { .. }) => SPEED_ABOVE / 100.0,
            (Mode::Direct, Motion::Linear { .. }) => SPEED_ABOVE,
        };
        // Written so that NaN is refused.
        if !(value > above && value <= at_most) {
            return Err(MotionError::Speed { value, above, at_most, unit });
        }
        Ok((value * scale).round() as i16)
    }

    /// The commands that give `motion` to the controller: the last moves, the others only prepare.
    fn requests(&self, motion: &Motion, speed: i16, figure: u8) -> Vec<Request> {
        let Self { config, .. } = self;
        let to = Place {
            coordinate_system: config.coordinate_system,
            pose: *motion.target(),
            figure: config.figure.unwrap_or(figure),
            tool: config.tool,
        };
        let variable = |index, value| Request::WriteVariable { index, value };
        match (&config.job, config.mode, motion) {
            (Some(job), Mode::Job, _) => vec![
                variable(job.target_variable, Value::Place(to)),
                variable(job.speed_variable, Value::Integer(speed)),
                variable(job.kind_variable, Value::Byte(if matches!(motion, Motion::Joint { .. }) { 1 } else { 2 })),
                Request::Start { job: job.name.clone() },
            ],
            (_, _, Motion::Joint { speed_fraction, .. }) => {
                vec![Request::MoveJoint { speed_percent: speed_fraction * 100.0, to }]
            }
            (_, _, Motion::Linear { speed_mm_s, .. }) => {
                vec![Request::MoveLinear { speed: LinearSpeed::MillimetresPerSecond(*speed_mm_s), to }]
            }
        }
    }

    /// Gives a command to the controller: from here on its id is used.
    fn give(&mut self, id: CommandId, what: Doing, requests: Vec<Request>) -> Result<(), Rejection> {
        let not_sent = Outcome::NotExecuted { reason: "it was not sent".into() };
        let began = self.clock.now();
        self.last = Some(Last { id, outcome: not_sent, what: what.clone(), began, ran: false, held: false });
        let count = requests.len();
        for (number, request) in requests.iter().enumerate() {
            let moves = number + 1 == count;
            let Err(failure) = self.exchange(request) else { continue };
            let cause = failure.cause();
            let (rejection, outcome) = match failure {
                Failure::Refused(code) => {
                    if matches!(code, 2060 | 2070 | 2080 | 2100) {
                        self.latch(&cause);
                    }
                    let meaning = meaning(code).to_string();
                    (Rejection::Refused { code, meaning }, Outcome::NotExecuted { reason: cause })
                }
                Failure::Broken(Broken { known: Known::Unknown, .. }) if moves => {
                    self.latch(&format!("the outcome of command {id} is unknown: {cause}"));
                    if let Doing::Gripper { .. } = what {
                        self.gripper = GripperState::Unknown;
                    }
                    (Rejection::NoAnswer { cause: cause.clone() }, Outcome::Unknown { reason: cause })
                }
                // A variable that may or may not be written moves nothing.
                Failure::NotConnected | Failure::Request(_) | Failure::Broken(_) => {
                    (Rejection::NotSent { cause: cause.clone() }, Outcome::NotExecuted { reason: cause })
                }
            };
            self.set_outcome(outcome);
            return Err(rejection);
        }
        let now = self.clock.now();
        if let Some(last) = &mut self.last {
            (last.outcome, last.began) = (Outcome::Accepted, now);
        }
        if let Doing::Gripper { .. } = what {
            self.gripper = GripperState::Moving;
        }
        Ok(())
    }

    fn set_outcome(&mut self, outcome: Outcome) {
        if let Some(last) = &mut self.last {
            last.outcome = outcome;
        }
    }

    fn abort(&mut self, reason: AbortReason) {
        if reason != AbortReason::Hold {
            self.latch(&reason.to_string());
        }
        self.set_outcome(Outcome::Aborted { reason });
    }

    /// Says how a gripper command ended, if it did. `status` is as the controller told it.
    fn conclude_gripper(&mut self, status: &Status) {
        let (now, takes, grace) = (self.clock.now(), self.gripper_time(), self.start_grace());
        let Some(last @ Last { outcome: Outcome::Accepted, what: Doing::Gripper { .. }, .. }) = &mut self.last else {
            return;
        };
        let Doing::Gripper { ends, job } = last.what else { return };
        last.ran |= status.running;
        let waited = now.saturating_sub(last.began);
        if let Some(reason) = stopped_by(status) {
            self.gripper = GripperState::Unknown;
            self.abort(reason);
        } else if waited >= takes && (!job || !status.running && (last.ran || waited >= grace)) {
            self.gripper = ends;
            self.set_outcome(Outcome::Done);
        }
    }

    /// Says how a motion ended, if it did.
    fn conclude_motion(&mut self, status: &Status, running: bool, at: &Pose) -> Result<(), StatusError> {
        let (now, grace) = (self.clock.now(), self.start_grace());
        let (mm, rad) = (self.config.tolerance_mm, self.config.tolerance_deg.to_radians());
        let Some(last @ Last { outcome: Outcome::Accepted, what: Doing::Motion { .. }, .. }) = &mut self.last else {
            return Ok(());
        };
        let Doing::Motion { target, job } = last.what.clone() else { return Ok(()) };
        last.ran |= running;
        let may_begin_yet = !last.ran && now.saturating_sub(last.began) < grace;
        let held = last.held;
        if !running && at.distance_mm(&target) <= mm && at.angle_rad(&target) <= rad {
            self.set_outcome(Outcome::Done);
        } else if let Some(reason) = stopped_by(status) {
            self.abort(reason);
        } else if running {
            if let Some(ours) = job {
                let line = self.read(&Request::ReadJob)?;
                let reply = JobReply::parse(&line).map_err(|e| StatusError::Malformed { answer: e.answer })?;
                if reply.job != ours {
                    self.abort(AbortReason::OtherJob { job: reply.job });
                }
            }
        } else if held {
            self.abort(AbortReason::Hold);
        } else if !may_begin_yet {
            let remaining_um = (at.distance_mm(&target) * 1000.0).round() as u64;
            self.abort(AbortReason::StoppedShort { remaining_um });
        }
        Ok(())
    }

    fn gripper_time(&self) -> Duration {
        Duration::from_millis(self.config.gripper_time_ms)
    }

    fn start_grace(&self) -> Duration {
        Duration::from_millis(self.config.start_grace_ms)
    }
}

/// What a robot that was ready has lost, and what an operator must look at.
fn lost(status: &Status) -> Option<AbortReason> {
    if status.emergency_stop {
        Some(AbortReason::EmergencyStop)
    } else if let Some(code) = status.alarm {
        Some(AbortReason::Alarm { code })
    } else if !status.remote || !status.play {
        Some(AbortReason::NotRemote)
    } else if !status.servo_on {
        Some(AbortReason::ServoOff)
    } else {
        None
    }
}

/// Why the robot does not go on.
fn stopped_by(status: &Status) -> Option<AbortReason> {
    let held = status.hold_command || status.hold_external || status.hold_pendant;
    lost(status).or_else(|| held.then_some(AbortReason::Hold))
}

impl Controller for Motoman {
    fn name(&self) -> &str {
        "motoman"
    }

    fn connect(&mut self) -> Result<(), ConnectError> {
        self.open()
    }

    fn status(&mut self) -> Result<Status, StatusError> {
        Ok(self.read_status()?.0)
    }

    fn position(&mut self) -> Result<Pose, PositionError> {
        Ok(self.read_place()?.pose)
    }

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        if !self.is_connected() {
            return Err(MotionError::NotConnected);
        }
        self.check_fresh(id).map_err(|last| MotionError::StaleId { id, last })?;
        motion.target().check()?;
        let speed = self.check_speed(motion)?;
        self.check_ready()?;
        // Told to keep flip, elbow and front or back as they are, the arm does not turn itself over on the way.
        let here = self.read_place().map_err(|e| MotionError::NotSent { cause: e.to_string() })?;
        let job = match (&self.config.job, self.config.mode) {
            (Some(job), Mode::Job) => Some(job.name.clone()),
            _ => None,
        };
        let requests = self.requests(motion, speed, here.figure);
        Ok(self.give(id, Doing::Motion { target: *motion.target(), job }, requests)?)
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        if !self.is_connected() {
            return Err(GripperError::NotConnected);
        }
        self.check_fresh(id).map_err(|last| GripperError::StaleId { id, last })?;
        self.check_ready()?;
        let open = command == GripperCommand::Open;
        let ends = if open { GripperState::Open } else { GripperState::Closed };
        let (request, job) = match &self.config.gripper {
            GripperConfig::Io { start_address, open_bits, close_bits } => {
                let bytes = vec![if open { *open_bits } else { *close_bits }];
                (Request::WriteIo { start_address: *start_address, bytes }, false)
            }
            GripperConfig::Jobs { open_job, close_job } => {
                let job = if open { open_job } else { close_job };
                (Request::Start { job: job.clone() }, true)
            }
        };
        Ok(self.give(id, Doing::Gripper { ends, job }, vec![request])?)
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        let (status, running) = self.read_status()?;
        let position = self.read_place()?.pose;
        match &self.last {
            Some(last) if last.id == id => {}
            last => return Err(PollError::NotTheLast { id, last: last.as_ref().map(|last| last.id) }),
        }
        self.conclude_motion(&status, running, &position)?;
        let status = Status { latched: self.latched.clone(), ..status };
        let outcome = self.last.as_ref().map_or(Outcome::Accepted, |last| last.outcome.clone());
        Ok(Progress { outcome, state: RobotState { status, position } })
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        match self.exchange(&Request::Hold { on }) {
            Ok(_) => {
                if let Some(last) = self.last.as_mut().filter(|_| on) {
                    last.held = true;
                }
                Ok(())
            }
            Err(Failure::NotConnected) => Err(HoldError::NotConnected),
            Err(Failure::Refused(code)) => Err(HoldError::Refused { code, meaning: meaning(code).to_string() }),
            Err(failure) => Err(HoldError::NoAnswer { cause: failure.cause() }),
        }
    }

    /// The first reason stays: later ones are mostly its consequences.
    fn latch(&mut self, reason: &str) {
        self.latched.get_or_insert_with(|| reason.to_string());
    }

    fn resume(&mut self) -> Result<Pose, ResumeError> {
        let (status, running) = self.read_status()?;
        Status { latched: None, running, ..status }.check_ready()?;
        let position = self.read_place()?.pose;
        // Read again behind the position: what has moved since was not where the operator believes it is.
        if self.read_status()?.1 {
            return Err(NotReady::Running.into());
        }
        if self.latched.take().is_some() {
            if self.gripper == GripperState::Moving {
                self.gripper = GripperState::Unknown;
            }
            if let Some(last) = self.last.as_mut().filter(|last| last.outcome == Outcome::Accepted) {
                let reason = "an operator resumed before its end was known".to_string();
                last.outcome = Outcome::Unknown { reason };
            }
        }
        Ok(position)
    }
}
