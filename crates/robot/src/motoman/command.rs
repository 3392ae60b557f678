//! The commands of the host control, and what their answers hold.
//!
//! A [`Request`] becomes a header line and, for most, a data line. Millimetres go out with three decimals, degrees with
//! four; a number that is not finite is refused here, before anything is written. Answers are comma separated numbers.

use std::fmt::Write as _;

use crate::{Pose, PoseError};

/// End of a data line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Terminator {
    /// CR, which most controllers expect.
    #[default]
    Cr,
    /// CR and LF.
    CrLf,
}

impl Terminator {
    fn text(self) -> &'static str {
        match self {
            Self::Cr => "\r",
            Self::CrLf => "\r\n",
        }
    }
}

/// A place that a controller is told: a pose, and what else tells one configuration of the arm from another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Number of the coordinate system: 0 base, 1 robot, 2 and up user.
    pub coordinate_system: u8,
    /// The pose in it.
    pub pose: Pose,
    /// Type bits: flip, elbow, front or back, R, T, S beyond 180 deg.
    pub figure: u8,
    /// Tool number.
    pub tool: u8,
}

/// Speed of a linear motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LinearSpeed {
    /// Of the tool centre point, mm/s.
    MillimetresPerSecond(f64),
    /// Of the rotation of the tool, deg/s.
    DegreesPerSecond(f64),
}

/// A variable of the controller and its value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// B: a byte.
    Byte(u8),
    /// I: 16 bits.
    Integer(i16),
    /// D: 32 bits.
    Double(i32),
    /// R: a real number.
    Real(f64),
    /// P: a position.
    Place(Place),
    /// S: a string of up to 16 printable characters.
    Text(String),
}

/// Kind of a variable, as it is counted on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// B
    Byte = 0,
    /// I
    Integer = 1,
    /// D
    Double = 2,
    /// R
    Real = 3,
    /// P
    Place = 4,
    /// S
    Text = 7,
}

/// A request to a controller.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    /// RSTATS: status bits, see [`StatusBits`].
    ReadStatus,
    /// RPOSC: where the tool is, see [`PlaceReply`].
    ReadPlace {
        /// In which coordinate system.
        coordinate_system: u8,
    },
    /// RPOSJ: pulses of the joints, see [`read_pulses`].
    ReadPulses,
    /// RALARM: errors and alarms, see [`read_alarm`].
    ReadAlarm,
    /// RJSEQ: the job, see [`JobReply`].
    ReadJob,
    /// SVON: servo power on or off.
    Servo {
        /// On.
        on: bool,
    },
    /// HOLD on or off.
    Hold {
        /// On.
        on: bool,
    },
    /// RESET: resets an alarm.
    ResetAlarm,
    /// CANCEL: cancels an error.
    CancelError,
    /// START: starts a job.
    Start {
        /// Name of the job; empty for the current one.
        job: String,
    },
    /// JSEQ: makes a job the current one.
    SelectJob {
        /// Name of the job.
        job: String,
        /// Line of it.
        line: u32,
    },
    /// MOVL: the tool on a straight line.
    MoveLinear {
        /// Speed.
        speed: LinearSpeed,
        /// Where to.
        to: Place,
    },
    /// MOVJ: every joint at once.
    MoveJoint {
        /// Percent of the greatest speed.
        speed_percent: f64,
        /// Where to.
        to: Place,
    },
    /// IMOV: the tool on a straight line, by an increment.
    MoveBy {
        /// Speed.
        speed: LinearSpeed,
        /// By how much.
        by: Place,
    },
    /// PMOVJ: every joint at once, to pulses.
    MovePulses {
        /// Percent of the greatest speed.
        speed_percent: f64,
        /// S, L, U, R, B, T.
        pulses: [i64; 6],
        /// Tool number.
        tool: u8,
    },
    /// IOREAD: inputs or outputs, see [`read_bytes`].
    ReadIo {
        /// Address of the first bit; ends in 0.
        start_address: u32,
        /// Bytes, 1 to 32.
        bytes: u8,
    },
    /// IOWRITE: network inputs.
    WriteIo {
        /// Address of the first bit; ends in 0.
        start_address: u32,
        /// What to write, 1 to 32 bytes.
        bytes: Vec<u8>,
    },
    /// SAVEV: a variable; its value comes back as it is written in the answer.
    ReadVariable {
        /// Kind.
        kind: Kind,
        /// Index.
        index: u16,
    },
    /// LOADV: writes a variable.
    WriteVariable {
        /// Index.
        index: u16,
        /// Kind and value.
        value: Value,
    },
}

/// What happens at the robot when a command gets there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// Nothing: it only reads.
    Reads,
    /// Something is set or moves: a lost answer leaves it unknown.
    Acts,
}

/// A request as it goes over the wire.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Encoded {
    /// Name of the command.
    pub name: &'static str,
    /// The header line with its end.
    pub header: Vec<u8>,
    /// The data line with its end, if the command has one.
    pub data: Option<Vec<u8>>,
    /// What it does.
    pub effect: Effect,
}

/// Why a request cannot be written.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RequestError {
    /// A pose has a number that is none.
    #[error(transparent)]
    Pose(#[from] PoseError),
    /// A number is out of range.
    #[error("{name} of {command} is {value}; it must be {allowed}")]
    OutOfRange {
        /// Of which command.
        command: &'static str,
        /// What.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A text is none that a controller takes.
    #[error("{name} {text:?} of {command}; it must be {allowed}")]
    Text {
        /// Of which command.
        command: &'static str,
        /// What.
        name: &'static str,
        /// The text.
        text: String,
        /// What is allowed.
        allowed: &'static str,
    },
}

/// Longest name of a job, characters.
pub const JOB_NAME_MAX: usize = 32;

/// Whether a controller can have a job of that name: 1 to 32 printable ASCII characters, no comma, no space.
pub fn is_job_name(name: &str) -> bool {
    (1..=JOB_NAME_MAX).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_graphic() && b != b',')
}

impl Request {
    /// Name of the command on the wire.
    pub fn name(&self) -> &'static str {
        match self {
            Self::ReadStatus => "RSTATS",
            Self::ReadPlace { .. } => "RPOSC",
            Self::ReadPulses => "RPOSJ",
            Self::ReadAlarm => "RALARM",
            Self::ReadJob => "RJSEQ",
            Self::Servo { .. } => "SVON",
            Self::Hold { .. } => "HOLD",
            Self::ResetAlarm => "RESET",
            Self::CancelError => "CANCEL",
            Self::Start { .. } => "START",
            Self::SelectJob { .. } => "JSEQ",
            Self::MoveLinear { .. } => "MOVL",
            Self::MoveJoint { .. } => "MOVJ",
            Self::MoveBy { .. } => "IMOV",
            Self::MovePulses { .. } => "PMOVJ",
            Self::ReadIo { .. } => "IOREAD",
            Self::WriteIo { .. } => "IOWRITE",
            Self::ReadVariable { .. } => "SAVEV",
            Self::WriteVariable { .. } => "LOADV",
        }
    }

    /// What happens at the robot.
    pub fn effect(&self) -> Effect {
        match self {
            Self::ReadStatus
            | Self::ReadPlace { .. }
            | Self::ReadPulses
            | Self::ReadAlarm
            | Self::ReadJob
            | Self::ReadIo { .. }
            | Self::ReadVariable { .. } => Effect::Reads,
            _ => Effect::Acts,
        }
    }

    /// Header and data as they go over the wire. The size in the header counts the end of the data line.
    ///
    /// # Errors
    /// [`RequestError`] names what cannot be written.
    pub fn encode(&self, terminator: Terminator) -> Result<Encoded, RequestError> {
        let data = self.data()?.map(|data| (data + terminator.text()).into_bytes());
        let size = data.as_ref().map_or(0, Vec::len);
        let header = format!("HOSTCTRL_REQUEST {} {size}\r\n", self.name()).into_bytes();
        Ok(Encoded { name: self.name(), header, data, effect: self.effect() })
    }

    fn data(&self) -> Result<Option<String>, RequestError> {
        const NO_EXTERNAL_AXES: &str = "0,0,0,0,0,0";
        Ok(Some(match self {
            Self::ReadStatus
            | Self::ReadPulses
            | Self::ReadAlarm
            | Self::ReadJob
            | Self::ResetAlarm
            | Self::CancelError => return Ok(None),
            Self::ReadPlace { coordinate_system } => format!("{coordinate_system},0"),
            Self::Servo { on } | Self::Hold { on } => u8::from(*on).to_string(),
            // An empty name, the current job, is still a line.
            Self::Start { job } if job.is_empty() => String::new(),
            Self::Start { job } => self.job(job)?.to_string(),
            Self::SelectJob { job, line } => format!("{},{line}", self.job(job)?),
            Self::MoveLinear { speed, to: place } | Self::MoveBy { speed, by: place } => {
                format!("{},{},{NO_EXTERNAL_AXES}", self.linear_speed(*speed)?, self.place(place)?)
            }
            Self::MoveJoint { speed_percent, to } => {
                format!("{:.2},{},{NO_EXTERNAL_AXES}", self.percent(*speed_percent)?, self.place(to)?)
            }
            Self::MovePulses { speed_percent, pulses, tool } => {
                let pulses = pulses.map(|count| count.to_string()).join(",");
                format!("{:.2},{pulses},{NO_EXTERNAL_AXES},{tool}", self.percent(*speed_percent)?)
            }
            Self::ReadIo { start_address, bytes } => {
                self.io(*start_address, usize::from(*bytes))?;
                format!("{start_address},{}", u32::from(*bytes) * 8)
            }
            Self::WriteIo { start_address, bytes } => {
                self.io(*start_address, bytes.len())?;
                let mut line = format!("{start_address},{}", bytes.len() * 8);
                for byte in bytes {
                    // Writing to a string cannot fail.
                    let _ = write!(line, ",{byte}");
                }
                line
            }
            Self::ReadVariable { kind, index } => format!("{},{index}", *kind as u8),
            Self::WriteVariable { index, value } => match value {
                Value::Byte(value) => format!("0,{index},{value}"),
                Value::Integer(value) => format!("1,{index},{value}"),
                Value::Double(value) => format!("2,{index},{value}"),
                Value::Real(value) => format!("3,{index},{}", self.finite("the value", *value)?),
                Value::Place(place) => format!("4,{index},1,{}", self.place(place)?),
                Value::Text(text) => {
                    if text.len() > 16 || !text.bytes().all(|b| matches!(b, b' '..=b'~') && b != b',') {
                        return Err(self.text("the value", text, "up to 16 printable ASCII characters, no comma"));
                    }
                    format!("7,{index},{text}")
                }
            },
        }))
    }

    /// `coord,X,Y,Z,Tx,Ty,Tz,type,tool`
    fn place(&self, place: &Place) -> Result<String, RequestError> {
        place.pose.check()?;
        let pose = &place.pose;
        let mut line = place.coordinate_system.to_string();
        for (name, mm) in [("x_mm", pose.x_mm), ("y_mm", pose.y_mm), ("z_mm", pose.z_mm)] {
            // Beyond any robot; keeps a number from being longer than a line.
            if mm.abs() >= 1e6 {
                let (command, value, allowed) = (self.name(), mm, "within 1000 m");
                return Err(RequestError::OutOfRange { command, name, value, allowed });
            }
            let _ = write!(line, ",{:.3}", without_minus_zero(mm, 1e3));
        }
        for rad in [pose.rx_rad, pose.ry_rad, pose.rz_rad] {
            let _ = write!(line, ",{:.4}", without_minus_zero(turn_deg(rad), 1e4));
        }
        let _ = write!(line, ",{},{}", place.figure, place.tool);
        Ok(line)
    }

    fn linear_speed(&self, speed: LinearSpeed) -> Result<String, RequestError> {
        let (select, name, value) = match speed {
            LinearSpeed::MillimetresPerSecond(value) => (0, "the speed in mm/s", value),
            LinearSpeed::DegreesPerSecond(value) => (1, "the speed in deg/s", value),
        };
        Ok(format!("{select},{:.2}", self.between(name, value, 10_000.0, "above 0.005 and at most 10000")?))
    }

    fn percent(&self, value: f64) -> Result<f64, RequestError> {
        self.between("the speed in percent", value, 100.0, "above 0.005 and at most 100")
    }

    fn between(&self, name: &'static str, value: f64, most: f64, allowed: &'static str) -> Result<f64, RequestError> {
        // Written so that NaN is refused; less would be written as 0.00.
        if value > SPEED_ABOVE && value <= most {
            return Ok(value);
        }
        Err(RequestError::OutOfRange { command: self.name(), name, value, allowed })
    }

    fn finite(&self, name: &'static str, value: f64) -> Result<f64, RequestError> {
        if value.is_finite() {
            return Ok(value);
        }
        Err(RequestError::OutOfRange { command: self.name(), name, value, allowed: "a finite number" })
    }

    fn io(&self, start_address: u32, bytes: usize) -> Result<(), RequestError> {
        let command = self.name();
        if !start_address.is_multiple_of(10) {
            let (name, value) = ("the start address", f64::from(start_address));
            return Err(RequestError::OutOfRange { command, name, value, allowed: "a multiple of 10" });
        }
        if !(1..=32).contains(&bytes) {
            let (name, value) = ("the number of bytes", bytes as f64);
            return Err(RequestError::OutOfRange { command, name, value, allowed: "1 to 32" });
        }
        Ok(())
    }

    fn job<'a>(&self, name: &'a str) -> Result<&'a str, RequestError> {
        if is_job_name(name) {
            return Ok(name);
        }
        Err(self.text("the job", name, "1 to 32 printable ASCII characters, no comma, no space"))
    }

    fn text(&self, name: &'static str, text: &str, allowed: &'static str) -> RequestError {
        RequestError::Text { command: self.name(), name, text: text.to_string(), allowed }
    }
}

/// Speeds are written with two decimals: what is not above this would be written as zero.
pub(crate) const SPEED_ABOVE: f64 = 0.005;

/// An angle in (-180, 180] deg.
fn turn_deg(rad: f64) -> f64 {
    let deg = rad.to_degrees() % 360.0;
    match deg {
        d if d > 180.0 => d - 360.0,
        d if d <= -180.0 => d + 360.0,
        d => d,
    }
}

/// So that what is rounded to zero is not written as -0.000.
fn without_minus_zero(value: f64, scale: f64) -> f64 {
    (value * scale).round() / scale + 0.0
}

/// Why an answer is not what the command calls for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{answer:?} is no answer to {command}, which is {expected}")]
pub struct AnswerError {
    /// The command.
    pub command: &'static str,
    /// What came, shortened.
    pub answer: String,
    /// What should have come.
    pub expected: &'static str,
}

fn numbers<T: std::str::FromStr>(line: &str) -> Option<Vec<T>> {
    line.split(',').map(|field| field.trim().parse().ok()).collect()
}

fn wrong(command: &'static str, line: &str, expected: &'static str) -> AnswerError {
    AnswerError { command, answer: super::reply::shortened(line.as_bytes()), expected }
}

/// Answer to RSTATS.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StatusBits {
    /// Takes commands from a host.
    pub command_remote: bool,
    /// Play mode.
    pub play: bool,
    /// Teach mode.
    pub teach: bool,
    /// Safety speed.
    pub safety_speed: bool,
    /// Running.
    pub running: bool,
    /// Automatic cycle.
    pub auto: bool,
    /// One cycle.
    pub one_cycle: bool,
    /// Step by step.
    pub step: bool,
    /// Servo power is on.
    pub servo_on: bool,
    /// An error stands.
    pub error: bool,
    /// An alarm stands.
    pub alarm: bool,
    /// Hold by command.
    pub hold_command: bool,
    /// Hold by an outside signal.
    pub hold_external: bool,
    /// Hold by the pendant.
    pub hold_pendant: bool,
}

impl StatusBits {
    /// Reads `d1,d2`.
    ///
    /// # Errors
    /// [`AnswerError`]
    pub fn parse(line: &str) -> Result<Self, AnswerError> {
        let Some([first, second]) = numbers::<u8>(line).and_then(|n| <[u8; 2]>::try_from(n).ok()) else {
            return Err(wrong("RSTATS", line, "two numbers of 0 to 255"));
        };
        let bit = |byte: u8, number: u8| byte >> number & 1 == 1;
        Ok(Self {
            command_remote: bit(first, 7),
            play: bit(first, 6),
            teach: bit(first, 5),
            safety_speed: bit(first, 4),
            running: bit(first, 3),
            auto: bit(first, 2),
            one_cycle: bit(first, 1),
            step: bit(first, 0),
            servo_on: bit(second, 6),
            error: bit(second, 5),
            alarm: bit(second, 4),
            hold_command: bit(second, 3),
            hold_external: bit(second, 2),
            hold_pendant: bit(second, 1),
        })
    }

    /// `d1,d2`
    pub fn line(&self) -> String {
        let byte = |bits: [bool; 8]| bits.into_iter().fold(0_u8, |byte, bit| byte << 1 | u8::from(bit));
        let first = byte([
            self.command_remote,
            self.play,
            self.teach,
            self.safety_speed,
            self.running,
            self.auto,
            self.one_cycle,
            self.step,
        ]);
        let (held, out, pendant) = (self.hold_command, self.hold_external, self.hold_pendant);
        let second = byte([false, self.servo_on, self.error, self.alarm, held, out, pendant, false]);
        format!("{first},{second}")
    }
}

/// Answer to RPOSC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceReply {
    /// Where the tool is, in the coordinate system that was asked for.
    pub pose: Pose,
    /// Type bits.
    pub figure: u8,
    /// Tool number.
    pub tool: u8,
}

impl PlaceReply {
    /// Reads `X,Y,Z,Tx,Ty,Tz,type,tool[,ext]`.
    ///
    /// # Errors
    /// [`AnswerError`]
    pub fn parse(line: &str) -> Result<Self, AnswerError> {
        let expected = "six finite numbers of mm and deg, type and tool of 0 to 255, and up to six external axes";
        let error = || wrong("RPOSC", line, expected);
        let fields = numbers::<f64>(line).ok_or_else(error)?;
        let [x_mm, y_mm, z_mm, rx_deg, ry_deg, rz_deg, figure, tool, external @ ..] = &fields[..] else {
            return Err(error());
        };
        let small = |value: f64| (value.fract() == 0.0 && (0.0..=255.0).contains(&value)).then_some(value as u8);
        let (Some(figure), Some(tool)) = (small(*figure), small(*tool)) else {
            return Err(error());
        };
        if external.len() > 6 || fields.iter().any(|value| !value.is_finite()) {
            return Err(error());
        }
        let pose = Pose {
            x_mm: *x_mm,
            y_mm: *y_mm,
            z_mm: *z_mm,
            rx_rad: rx_deg.to_radians(),
            ry_rad: ry_deg.to_radians(),
            rz_rad: rz_deg.to_radians(),
        };
        Ok(Self { pose, figure, tool })
    }

    /// `X,Y,Z,Tx,Ty,Tz,type,tool`
    ///
    /// # Errors
    /// [`RequestError`] if the pose has a number that cannot be written.
    pub fn line(&self) -> Result<String, RequestError> {
        let Self { pose, figure, tool } = *self;
        let line =
            Request::ReadPlace { coordinate_system: 0 }.place(&Place { coordinate_system: 0, pose, figure, tool })?;
        // The coordinate system is that which was asked for.
        Ok(line.split_once(',').map_or_else(String::new, |(_, rest)| rest.to_string()))
    }
}

/// Reads the answer to RPOSJ: at least six counts of S, L, U, R, B, T; of external axes nothing is kept.
///
/// # Errors
/// [`AnswerError`]
pub fn read_pulses(line: &str) -> Result<[i64; 6], AnswerError> {
    let counts = numbers::<i64>(line).filter(|counts| (6..=12).contains(&counts.len()));
    let first = counts.and_then(|counts| <[i64; 6]>::try_from(&counts[..6]).ok());
    first.ok_or_else(|| wrong("RPOSJ", line, "6 to 12 whole numbers"))
}

/// Reads the answer to RALARM: the code that stands, an alarm before an error, or `None`.
///
/// Both forms that controllers have are understood: the error alone or with its data, then pairs of alarm code and data.
///
/// # Errors
/// [`AnswerError`]
pub fn read_alarm(line: &str) -> Result<Option<u32>, AnswerError> {
    let expected = "whole numbers: an error, then pairs of alarm code and data";
    let fields = numbers::<i64>(line).ok_or_else(|| wrong("RALARM", line, expected))?;
    let alarms_begin = if fields.len() % 2 == 0 { 2 } else { 1 };
    let alarms = fields.iter().skip(alarms_begin).step_by(2);
    let code = alarms.chain(fields.first()).copied().find(|code| *code != 0);
    match code.map(u32::try_from) {
        None => Ok(None),
        Some(Ok(code)) => Ok(Some(code)),
        Some(Err(_)) => Err(wrong("RALARM", line, expected)),
    }
}

/// Answer to RJSEQ.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobReply {
    /// Name of the job.
    pub job: String,
    /// Line that is executed.
    pub line: u32,
    /// Step that is executed.
    pub step: u32,
}

impl JobReply {
    /// Reads `JOB,line,step`.
    ///
    /// # Errors
    /// [`AnswerError`]
    pub fn parse(line: &str) -> Result<Self, AnswerError> {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        match fields[..] {
            [job, at_line, step] if is_job_name(job) => at_line.parse().ok().zip(step.parse().ok()),
            _ => None,
        }
        .map(|(at_line, step)| Self { job: fields[0].to_string(), line: at_line, step })
        .ok_or_else(|| wrong("RJSEQ", line, "a job, a line and a step"))
    }
}

/// Reads the answer to IOREAD of so many bytes.
///
/// # Errors
/// [`AnswerError`]
pub fn read_bytes(line: &str, bytes: usize) -> Result<Vec<u8>, AnswerError> {
    numbers::<u8>(line)
        .filter(|read| read.len() == bytes)
        .ok_or_else(|| wrong("IOREAD", line, "one number of 0 to 255 for every byte"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn wire(request: &Request) -> (String, String) {
        let encoded = request.encode(Terminator::Cr).unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (text(encoded.header), encoded.data.map(text).unwrap_or_default())
    }

    fn place() -> Place {
        let pose = Pose { x_mm: 412.3456, y_mm: -0.0001, z_mm: 90.0, rx_rad: -PI, ry_rad: 0.0, rz_rad: 1.5 * PI };
        Place { coordinate_system: 0, pose, figure: 1, tool: 2 }
    }

    #[test]
    fn every_command_of_the_table_is_written_as_the_controller_reads_it() {
        let job = || "PICK-1".to_string();
        let speed = LinearSpeed::MillimetresPerSecond(150.0);
        let cases = [
            (Request::ReadStatus, "RSTATS 0", ""),
            (Request::ReadPlace { coordinate_system: 1 }, "RPOSC 4", "1,0\r"),
            (Request::ReadPulses, "RPOSJ 0", ""),
            (Request::ReadAlarm, "RALARM 0", ""),
            (Request::ReadJob, "RJSEQ 0", ""),
            (Request::Servo { on: true }, "SVON 2", "1\r"),
            (Request::Hold { on: false }, "HOLD 2", "0\r"),
            (Request::ResetAlarm, "RESET 0", ""),
            (Request::CancelError, "CANCEL 0", ""),
            (Request::Start { job: job() }, "START 7", "PICK-1\r"),
            (Request::Start { job: String::new() }, "START 1", "\r"),
            (Request::SelectJob { job: job(), line: 3 }, "JSEQ 9", "PICK-1,3\r"),
            (
                Request::MoveLinear { speed, to: place() },
                "MOVL 73",
                "0,150.00,0,412.346,0.000,90.000,180.0000,0.0000,-90.0000,1,2,0,0,0,0,0,0\r",
            ),
            (
                Request::MoveJoint { speed_percent: 12.5, to: place() },
                "MOVJ 70",
                "12.50,0,412.346,0.000,90.000,180.0000,0.0000,-90.0000,1,2,0,0,0,0,0,0\r",
            ),
            (
                Request::MoveBy { speed: LinearSpeed::DegreesPerSecond(9.0), by: place() },
                "IMOV 71",
                "1,9.00,0,412.346,0.000,90.000,180.0000,0.0000,-90.0000,1,2,0,0,0,0,0,0\r",
            ),
            (
                Request::MovePulses { speed_percent: 5.0, pulses: [1, -2, 3, 4, 5, 6], tool: 7 },
                "PMOVJ 32",
                "5.00,1,-2,3,4,5,6,0,0,0,0,0,0,7\r",
            ),
            (Request::ReadIo { start_address: 27010, bytes: 2 }, "IOREAD 9", "27010,16\r"),
            (Request::WriteIo { start_address: 27010, bytes: vec![2, 255] }, "IOWRITE 15", "27010,16,2,255\r"),
            (Request::ReadVariable { kind: Kind::Text, index: 9 }, "SAVEV 4", "7,9\r"),
            (Request::WriteVariable { index: 5, value: Value::Byte(255) }, "LOADV 8", "0,5,255\r"),
            (
                Request::WriteVariable { index: 5, value: Value::Place(place()) },
                "LOADV 58",
                "4,5,1,0,412.346,0.000,90.000,180.0000,0.0000,-90.0000,1,2\r",
            ),
        ];
        for (request, header, data) in cases {
            assert_eq!(wire(&request), (format!("HOSTCTRL_REQUEST {header}\r\n"), data.to_string()), "{request:?}");
        }
        let counts = |request: &Request| wire(request).1.split(',').count();
        assert_eq!(counts(&Request::MoveLinear { speed, to: place() }), 17);
        assert_eq!(counts(&Request::MoveJoint { speed_percent: 1.0, to: place() }), 16);
    }

    #[test]
    fn the_size_counts_the_end_of_the_line_whichever_it_is() {
        let encoded = Request::Hold { on: true }.encode(Terminator::CrLf).unwrap();
        assert_eq!(encoded.header, b"HOSTCTRL_REQUEST HOLD 3\r\n");
        assert_eq!(encoded.data.unwrap(), b"1\r\n");
    }

    #[test]
    fn what_is_no_number_or_no_name_is_refused_by_name() {
        let mut bad = place();
        bad.pose.ry_rad = f64::NAN;
        let far = Place { pose: Pose { x_mm: 1e300, ..place().pose }, ..place() };
        let speed = LinearSpeed::MillimetresPerSecond;
        let cases = [
            (Request::MoveLinear { speed: speed(1.0), to: bad }, "ry_rad of a pose is NaN"),
            (Request::MoveJoint { speed_percent: 1.0, to: bad }, "ry_rad of a pose is NaN"),
            (Request::WriteVariable { index: 0, value: Value::Place(bad) }, "ry_rad of a pose is NaN"),
            (Request::MoveLinear { speed: speed(1.0), to: far }, "x_mm of MOVL is 1"),
            (Request::MoveLinear { speed: speed(f64::NAN), to: place() }, "the speed in mm/s of MOVL is NaN"),
            (Request::MoveLinear { speed: speed(0.004), to: place() }, "the speed in mm/s of MOVL is 0.004"),
            (Request::MoveJoint { speed_percent: 101.0, to: place() }, "the speed in percent of MOVJ is 101"),
            (Request::WriteVariable { index: 0, value: Value::Real(f64::INFINITY) }, "the value of LOADV is inf"),
            (Request::Start { job: "A\r\nB".into() }, "the job \"A\\r\\nB\" of START"),
            (Request::SelectJob { job: "A,B".into(), line: 0 }, "the job \"A,B\" of JSEQ"),
            (Request::WriteVariable { index: 0, value: Value::Text("a\r".into()) }, "the value \"a\\r\" of LOADV"),
            (Request::ReadIo { start_address: 27011, bytes: 1 }, "the start address of IOREAD is 27011"),
            (Request::WriteIo { start_address: 27010, bytes: vec![] }, "the number of bytes of IOWRITE is 0"),
        ];
        for (request, message) in cases {
            let error = request.encode(Terminator::Cr).unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
    }

    #[test]
    fn status_bits_are_those_of_the_manual() {
        let bits = StatusBits::parse("200, 64").unwrap();
        let ready =
            StatusBits { command_remote: true, play: true, running: true, servo_on: true, ..StatusBits::default() };
        assert_eq!(bits, ready);
        let bits = StatusBits::parse("32,62").unwrap();
        assert!(bits.teach && bits.error && bits.alarm && bits.hold_command && bits.hold_external && bits.hold_pendant);
        for line in ["0,0", "255,126", "200,64", "66,24"] {
            assert_eq!(StatusBits::parse(line).unwrap().line(), line);
        }
        for line in ["", "1", "1,2,3", "256,0", "-1,0", "a,b"] {
            assert!(StatusBits::parse(line).is_err(), "{line}");
        }
    }

    #[test]
    fn places_are_read_back_as_they_were_written() {
        let fields = PlaceReply { pose: place().pose, figure: 1, tool: 2 }.line().unwrap();
        let read = PlaceReply::parse(&fields).unwrap();
        assert_eq!((read.figure, read.tool), (1, 2));
        assert!(read.pose.distance_mm(&place().pose) < 1e-3 && read.pose.angle_rad(&place().pose) < 1e-5);
        let external = PlaceReply::parse("1.5, 2,3,180.0000,0,-90,4,0,0,0").unwrap();
        assert_eq!((external.pose.x_mm, external.pose.rz_rad, external.figure), (1.5, -PI / 2.0, 4));
        for line in
            ["", "1,2,3,4,5,6,7", "nan,2,3,4,5,6,0,0", "1,2,inf,4,5,6,0,0", "1,2,3,4,5,6,0.5,0", "1,2,3,4,5,6,0,-1"]
        {
            let error = PlaceReply::parse(line).unwrap_err();
            assert!(error.to_string().contains("RPOSC"), "{error}");
        }
    }

    #[test]
    fn an_alarm_goes_before_an_error() {
        let cases = [
            ("0,0,0,0", None),
            ("2060,0,4107,1,0,0", Some(4107)),
            ("2060,0,0,0", Some(2060)),
            ("0,4107,1", Some(4107)),
            ("0,0,0,0,4,7", Some(4)),
            ("5", Some(5)),
        ];
        for (line, code) in cases {
            assert_eq!(read_alarm(line), Ok(code), "{line}");
        }
        assert!(read_alarm("x").is_err() && read_alarm("-5,0").is_err());
    }

    #[test]
    fn other_answers_are_read_or_named() {
        assert_eq!(read_pulses("1,-2,3,4,5,6,0,0,0,0,0,0"), Ok([1, -2, 3, 4, 5, 6]));
        assert!(read_pulses("1,2,3").is_err() && read_pulses("1,2,3,4,5,6.5").is_err());
        assert_eq!(JobReply::parse("PICK,3, 1"), Ok(JobReply { job: "PICK".into(), line: 3, step: 1 }));
        assert!(JobReply::parse(",3,1").is_err() && JobReply::parse("PICK,3").is_err());
        assert_eq!(read_bytes("1,255", 2), Ok(vec![1, 255]));
        assert!(read_bytes("1", 2).is_err() && read_bytes("256", 1).is_err());
    }
}
