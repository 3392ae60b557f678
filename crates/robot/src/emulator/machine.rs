//! The robot and its controller as they are, whoever is connected.
//!
//! State is a function of the clock: nothing runs in the background, and whoever looks brings it up to date. The arm is an
//! [`ArmModel`]: what it cannot reach is answered 1012, as any operand out of range.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use super::config::EmulatorConfig;
use super::script::FaultKind;
use crate::motoman::command::{JOB_NAME_MAX, PlaceReply, StatusBits};
use crate::{ArmModel, ArmPath, Clock, Joints, MotionError, Pose, Workpieces};

/// Every command that the controller knows.
pub(super) const COMMANDS: [&str; 19] = [
    "RSTATS", "RPOSC", "RPOSJ", "RALARM", "RJSEQ", "SVON", "HOLD", "RESET", "CANCEL", "START", "JSEQ", "MOVL", "MOVJ",
    "IMOV", "PMOVJ", "IOREAD", "IOWRITE", "SAVEV", "LOADV",
];

/// Steps along a motion at which the workpieces are told where the tool is.
const STEP_MM: f64 = 2.0;
const STEP_RAD: f64 = 0.035;

/// Greatest speed of a linear motion, mm/s.
const LINEAR_SPEED_MAX_MM_S: f64 = 1500.0;

/// Longest time that a motion may take.
const LONGEST_MOTION: Duration = Duration::from_secs(24 * 3600);

/// Greatest index of a variable.
const INDEX_MAX: u16 = 99;

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Answer {
    Done,
    Data(String),
}

/// A variable as it was written: its value, for a position `1,coord,X,..`.
type Variables = BTreeMap<(u8, u16), String>;

pub(super) struct Machine {
    config: EmulatorConfig,
    clock: Arc<dyn Clock>,
    workpieces: Box<dyn Workpieces>,
    arm: ArmModel,
    at: Pose,
    joints: Joints,
    tool: u8,
    action: Option<Action>,
    /// When the gripper has moved, and whether it then is open.
    gripper: Option<(Duration, bool)>,
    holds_part: bool,
    remote: bool,
    play: bool,
    servo_on: bool,
    emergency_stop: bool,
    hold_command: bool,
    hold_external: bool,
    alarm: Option<u32>,
    error: Option<u32>,
    job: String,
    inputs: BTreeMap<u32, u8>,
    variables: Variables,
    pub(super) motions_begun: u64,
    /// A fault of the connection that a motion has brought; it shows at the next command.
    pub(super) pending: Option<FaultKind>,
}

struct Action {
    start: Duration,
    lasts: Duration,
    /// None while a job runs that moves no joint.
    path: Option<ArmPath>,
    /// Share of the way that the workpieces were told of.
    told: f64,
    stalled: bool,
    /// Share at which something happens.
    happens: Option<(f64, FaultKind)>,
}

impl Action {
    fn share(&self, now: Duration) -> f64 {
        let share = if self.lasts.is_zero() {
            1.0
        } else {
            (now.saturating_sub(self.start).as_secs_f64() / self.lasts.as_secs_f64()).clamp(0.0, 1.0)
        };
        // A stalled motion creeps up to its target and stays just short of it.
        if self.stalled { share.min(0.999) } else { share }
    }

    fn at_share(&self, share: f64) -> Duration {
        self.start + self.lasts.mul_f64(share)
    }
}

impl Machine {
    /// An arm that stands at home, where its joints are at these angles.
    pub(super) fn new(
        config: EmulatorConfig,
        joints: Joints,
        clock: Arc<dyn Clock>,
        workpieces: Box<dyn Workpieces>,
    ) -> Self {
        Self {
            arm: ArmModel::mh5(config.tool_length_mm),
            at: config.home,
            joints,
            job: config.move_job.name.clone(),
            config,
            clock,
            workpieces,
            tool: 0,
            action: None,
            gripper: None,
            holds_part: false,
            remote: true,
            play: true,
            servo_on: true,
            emergency_stop: false,
            hold_command: false,
            hold_external: false,
            alarm: None,
            error: None,
            inputs: BTreeMap::new(),
            variables: BTreeMap::new(),
            motions_begun: 0,
            pending: None,
        }
    }

    pub(super) fn now(&self) -> Duration {
        self.clock.now()
    }

    /// Brings everything up to the clock, in the order in which it happened, and says where the tool is.
    pub(super) fn update(&mut self) -> Pose {
        let now = self.clock.now();
        loop {
            let gripper = self.gripper.map(|(ends, _)| ends).filter(|ends| *ends <= now);
            let happens = self.action.as_ref().and_then(|action| {
                let (share, _) = action.happens?;
                Some(action.at_share(share)).filter(|when| *when <= now)
            });
            match (gripper, happens) {
                (Some(ends), _) if happens.is_none_or(|when| ends <= when) => {
                    self.go_on(ends);
                    let open = self.gripper.take().is_some_and(|(_, open)| open);
                    if open {
                        self.workpieces.open(&self.at);
                        self.holds_part = false;
                    } else {
                        self.holds_part = self.workpieces.close(&self.at);
                    }
                }
                (_, Some(when)) => {
                    self.go_on(when);
                    let happens = self.action.as_mut().and_then(|action| action.happens.take());
                    if let Some((_, fault)) = happens {
                        self.suffer(fault);
                    }
                }
                _ => break,
            }
        }
        self.go_on(now);
        self.at
    }

    /// Moves the tool to where it is at `when`.
    fn go_on(&mut self, when: Duration) {
        let Some(action) = &mut self.action else { return };
        let share = action.share(when);
        if let Some(path) = &action.path {
            let (from, to) = (path.tool(&self.arm, action.told), path.tool(&self.arm, share));
            // A joint motion bends: the chord between the ends is too short a measure of it.
            let middle = path.tool(&self.arm, (action.told + share) / 2.0);
            let way = from.distance_mm(&middle) + middle.distance_mm(&to);
            let steps = (way * 1.2 / STEP_MM).max(from.angle_rad(&to) / STEP_RAD).ceil().clamp(1.0, 10_000.0);
            if share > action.told {
                for step in 1..=(steps as u64) {
                    let passed = action.told + (share - action.told) * step as f64 / steps;
                    self.workpieces.passes(&path.tool(&self.arm, passed));
                }
                action.told = share;
            }
            (self.at, self.joints) = (to, path.joints(share));
        }
        if share >= 1.0 {
            self.action = None;
        }
    }

    /// Something happens to the robot; what happens to the connection is kept for the next command.
    pub(super) fn suffer(&mut self, fault: FaultKind) {
        match fault {
            FaultKind::EmergencyStop => {
                (self.emergency_stop, self.servo_on) = (true, false);
                self.action = None;
            }
            FaultKind::ServoOff => {
                self.servo_on = false;
                self.action = None;
            }
            FaultKind::Alarm { code } => {
                self.alarm = Some(code);
                self.action = None;
            }
            FaultKind::Error { code } => {
                self.error = Some(code);
                self.action = None;
            }
            FaultKind::ExternalHold => {
                self.hold_external = true;
                self.action = None;
            }
            FaultKind::Teach => {
                (self.play, self.remote) = (false, false);
                self.action = None;
            }
            FaultKind::StopShort => self.action = None,
            FaultKind::Stall => {
                if let Some(action) = &mut self.action {
                    action.stalled = true;
                }
            }
            connection => self.pending = Some(connection),
        }
    }

    /// Puts everything right, as a person at the robot does.
    pub(super) fn restore(&mut self) {
        self.update();
        (self.remote, self.play, self.servo_on) = (true, true, true);
        (self.emergency_stop, self.hold_external, self.alarm, self.error) = (false, false, None, None);
        self.pending = None;
        if self.action.as_ref().is_some_and(|action| action.stalled) {
            self.action = None;
        }
    }

    pub(super) fn execute(&mut self, command: &str, data: &str, mid: Option<(f64, FaultKind)>) -> Result<Answer, u32> {
        self.update();
        let fields: Vec<&str> = if data.is_empty() { Vec::new() } else { data.split(',').map(str::trim).collect() };
        match command {
            "RSTATS" => count(&fields, 0).map(|()| Answer::Data(self.status_bits().line())),
            "RPOSC" => {
                count(&fields, 2)?;
                self.coordinate_system(fields[0])?;
                let place = PlaceReply { pose: self.at, figure: self.config.figure, tool: self.tool };
                place.line().map(Answer::Data).map_err(|_| 2110)
            }
            "RPOSJ" => {
                count(&fields, 0)?;
                let counts = self.joints.0.iter().zip(self.config.pulses_per_deg);
                let pulses = counts.map(|(angle, per_deg)| format!("{:.0},", angle.to_degrees() * per_deg));
                Ok(Answer::Data(pulses.collect::<String>() + "0,0,0,0,0,0"))
            }
            "RALARM" => {
                count(&fields, 0)?;
                let (error, alarm) = (self.error.unwrap_or(0), self.alarm.unwrap_or(0));
                Ok(Answer::Data(format!("{error},0,{alarm},0,0,0,0,0,0,0")))
            }
            "RJSEQ" => count(&fields, 0).map(|()| Answer::Data(format!("{},1,1", self.job))),
            "IOREAD" => {
                count(&fields, 2)?;
                let (address, bytes) = io_range(&fields)?;
                let bytes: Vec<String> = (0..bytes).map(|n| self.byte_at(address + 10 * n).to_string()).collect();
                Ok(Answer::Data(bytes.join(",")))
            }
            "SAVEV" => self.save_variable(&fields),
            _ if !COMMANDS.contains(&command) => Err(1010),
            // Everything else changes something: a host may only do so in remote.
            _ if !self.play => Err(2080),
            _ if !self.remote => Err(2100),
            _ => self.act(command, data, &fields, mid),
        }
    }

    fn act(
        &mut self,
        command: &str,
        data: &str,
        fields: &[&str],
        mid: Option<(f64, FaultKind)>,
    ) -> Result<Answer, u32> {
        match command {
            "SVON" => {
                let on = switch(fields)?;
                if on && (self.emergency_stop || self.alarm.is_some() || self.error.is_some()) {
                    return Err(3450);
                }
                self.servo_on = on;
                if !on {
                    self.action = None;
                }
            }
            "HOLD" => {
                self.hold_command = switch(fields)?;
                if self.hold_command {
                    self.action = None;
                }
            }
            "RESET" => {
                count(fields, 0)?;
                self.alarm = None;
            }
            "CANCEL" => {
                count(fields, 0)?;
                self.error = None;
            }
            "JSEQ" => {
                count(fields, 2)?;
                integer(fields[1], 0, 9999)?;
                self.known_job(fields[0])?;
                self.ready()?;
                self.job = fields[0].to_string();
            }
            "START" => {
                let name = if data.trim().is_empty() { self.job.clone() } else { data.trim().to_string() };
                self.known_job(&name)?;
                self.ready()?;
                self.start_job(name, mid)?;
            }
            "MOVL" | "IMOV" => {
                count(fields, 17)?;
                let by_angle = integer(fields[0], 0, 1)? == 1;
                let most = if by_angle { 180.0 } else { LINEAR_SPEED_MAX_MM_S };
                let speed = positive(fields[1], most)?;
                let (mut to, tool) = self.place(&fields[2..11])?;
                externals(&fields[11..])?;
                if command == "IMOV" {
                    to = Pose {
                        x_mm: self.at.x_mm + to.x_mm,
                        y_mm: self.at.y_mm + to.y_mm,
                        z_mm: self.at.z_mm + to.z_mm,
                        rx_rad: self.at.rx_rad + to.rx_rad,
                        ry_rad: self.at.ry_rad + to.ry_rad,
                        rz_rad: self.at.rz_rad + to.rz_rad,
                    };
                }
                self.ready()?;
                if by_angle {
                    let path = self.line(&to, LINEAR_SPEED_MAX_MM_S)?;
                    let turning = self.at.angle_rad(&to) / speed.to_radians();
                    let lasts = path.lasts().as_secs_f64().max(turning);
                    self.begin(path, tool, lasts, mid)?;
                } else {
                    let path = self.line(&to, speed)?;
                    let lasts = path.lasts().as_secs_f64();
                    self.begin(path, tool, lasts, mid)?;
                }
            }
            "MOVJ" => {
                count(fields, 16)?;
                let percent = positive(fields[0], 100.0)?;
                let (to, tool) = self.place(&fields[1..10])?;
                externals(&fields[10..])?;
                self.ready()?;
                self.turn_to(&to, tool, percent / 100.0, mid)?;
            }
            "PMOVJ" => {
                count(fields, 14)?;
                let percent = positive(fields[0], 100.0)?;
                let mut to = Joints([0.0; 6]);
                for ((angle, field), per_deg) in to.0.iter_mut().zip(&fields[1..7]).zip(self.config.pulses_per_deg) {
                    *angle = (integer(field, i32::MIN.into(), i32::MAX.into())? as f64 / per_deg).to_radians();
                }
                externals(&fields[7..13])?;
                let tool = integer(fields[13], 0, 63)? as u8;
                self.ready()?;
                let path = self.arm.plan_turn(&self.joints, &to, percent / 100.0).map_err(out_of_reach)?;
                let lasts = path.lasts().as_secs_f64();
                self.begin(path, tool, lasts, mid)?;
            }
            "IOWRITE" => self.write_io(fields)?,
            "LOADV" => self.load_variable(fields)?,
            _ => return Err(1010),
        }
        Ok(Answer::Done)
    }

    fn status_bits(&self) -> StatusBits {
        StatusBits {
            command_remote: self.remote,
            play: self.play,
            teach: !self.play,
            running: self.action.is_some(),
            servo_on: self.servo_on,
            alarm: self.alarm.is_some(),
            error: self.error.is_some(),
            hold_command: self.hold_command,
            hold_external: self.hold_external,
            ..StatusBits::default()
        }
    }

    /// Whether a motion or job may start.
    fn ready(&self) -> Result<(), u32> {
        if self.alarm.is_some() || self.error.is_some() {
            Err(2060)
        } else if !self.servo_on {
            Err(2070)
        } else if self.hold_external {
            Err(2040)
        } else if self.hold_command {
            Err(2050)
        } else if self.action.is_some() {
            Err(2010)
        } else {
            Ok(())
        }
    }

    fn line(&self, to: &Pose, speed_mm_s: f64) -> Result<ArmPath, u32> {
        self.arm.plan_line(&self.joints, to, speed_mm_s, LINEAR_SPEED_MAX_MM_S).map_err(out_of_reach)
    }

    fn turn_to(&mut self, to: &Pose, tool: u8, speed_fraction: f64, mid: Option<(f64, FaultKind)>) -> Result<(), u32> {
        let path = self.arm.plan_joint(&self.joints, to, speed_fraction).map_err(out_of_reach)?;
        let lasts = path.lasts().as_secs_f64();
        self.begin(path, tool, lasts, mid)
    }

    fn begin(&mut self, path: ArmPath, tool: u8, seconds: f64, mid: Option<(f64, FaultKind)>) -> Result<(), u32> {
        // A crawl beyond any use, which would only make times overflow.
        let lasts =
            Duration::try_from_secs_f64(seconds).ok().filter(|lasts| *lasts <= LONGEST_MOTION).ok_or(1012_u32)?;
        self.tool = tool;
        self.motions_begun += 1;
        let start = self.clock.now();
        self.action = Some(Action { start, lasts, path: Some(path), told: 0.0, stalled: false, happens: mid });
        Ok(())
    }

    fn start_job(&mut self, name: String, mid: Option<(f64, FaultKind)>) -> Result<(), u32> {
        let config = &self.config;
        if name == config.move_job.name {
            let variable = |kind: u8, index: u16| self.variables.get(&(kind, index)).map(String::as_str);
            let place = variable(4, config.move_job.target_variable).ok_or(4130_u32)?;
            let fields: Vec<&str> = place.split(',').skip(1).collect();
            let (to, tool) = self.place(&fields)?;
            let speed = variable(1, config.move_job.speed_variable).and_then(|v| v.parse::<f64>().ok());
            let speed = speed.filter(|speed| *speed > 0.0).ok_or(5170_u32)?;
            match variable(0, config.move_job.kind_variable) {
                Some("1") if speed <= 10_000.0 => {
                    self.turn_to(&to, tool, speed / 10_000.0, mid)?;
                }
                Some("2") if speed <= LINEAR_SPEED_MAX_MM_S * 10.0 => {
                    let path = self.line(&to, speed / 10.0)?;
                    let lasts = path.lasts().as_secs_f64();
                    self.begin(path, tool, lasts, mid)?;
                }
                _ => return Err(5170),
            }
        } else {
            let open = name == config.gripper_open_job;
            let lasts = Duration::from_millis(config.gripper_time_ms);
            let start = self.clock.now();
            self.gripper = Some((start + lasts, open));
            self.action = Some(Action { start, lasts, path: None, told: 0.0, stalled: false, happens: mid });
        }
        self.job = name;
        Ok(())
    }

    fn known_job(&self, name: &str) -> Result<(), u32> {
        let config = &self.config;
        if name.len() > JOB_NAME_MAX {
            return Err(1013);
        }
        let known = [&config.move_job.name, &config.gripper_open_job, &config.gripper_close_job];
        if known.into_iter().any(|job| job == name) { Ok(()) } else { Err(4040) }
    }

    /// `coord,X,Y,Z,Tx,Ty,Tz,type,tool`
    fn place(&self, fields: &[&str]) -> Result<(Pose, u8), u32> {
        count(fields, 9)?;
        self.coordinate_system(fields[0])?;
        let mut numbers = [0.0; 6];
        for (number, field) in numbers.iter_mut().zip(&fields[1..7]) {
            *number = finite(field)?;
        }
        integer(fields[7], 0, 63)?;
        let tool = integer(fields[8], 0, 63)? as u8;
        let [x_mm, y_mm, z_mm, rx_deg, ry_deg, rz_deg] = numbers;
        let [rx_rad, ry_rad, rz_rad] = [rx_deg, ry_deg, rz_deg].map(f64::to_radians);
        Ok((Pose { x_mm, y_mm, z_mm, rx_rad, ry_rad, rz_rad }, tool))
    }

    /// Base and robot coordinates are the same here; user frames are not taught.
    fn coordinate_system(&self, field: &str) -> Result<(), u32> {
        if integer(field, 0, 65)? < 2 { Ok(()) } else { Err(3350) }
    }

    fn byte_at(&self, address: u32) -> u8 {
        let mut byte = self.inputs.get(&address).copied().unwrap_or(0);
        for (signal, on) in
            [(self.config.part_sensor, self.holds_part), (self.config.emergency_stop, self.emergency_stop)]
        {
            if signal.start_address == address {
                byte = byte & !(1 << signal.bit) | u8::from(on != signal.inverted) << signal.bit;
            }
        }
        byte
    }

    fn write_io(&mut self, fields: &[&str]) -> Result<(), u32> {
        if fields.len() < 3 {
            return Err(1011);
        }
        let (address, bytes) = io_range(fields)?;
        count(fields, 2 + bytes as usize)?;
        let mut values = Vec::new();
        for field in &fields[2..] {
            values.push(integer(field, 0, 255)? as u8);
        }
        for (address, value) in (address..).step_by(10).zip(values) {
            self.inputs.insert(address, value);
            if address == self.config.gripper_address {
                let ends = self.clock.now() + Duration::from_millis(self.config.gripper_time_ms);
                if value == self.config.gripper_open_bits {
                    self.gripper = Some((ends, true));
                } else if value == self.config.gripper_close_bits {
                    self.gripper = Some((ends, false));
                }
            }
        }
        Ok(())
    }

    fn save_variable(&self, fields: &[&str]) -> Result<Answer, u32> {
        count(fields, 2)?;
        let (kind, index) = variable(fields)?;
        match self.variables.get(&(kind, index)) {
            Some(value) => Ok(Answer::Data(value.clone())),
            // A position that was never taught.
            None if kind == 4 => Err(4130),
            None if kind == 7 => Ok(Answer::Data(String::new())),
            None => Ok(Answer::Data("0".into())),
        }
    }

    fn load_variable(&mut self, fields: &[&str]) -> Result<(), u32> {
        if fields.len() < 3 {
            return Err(1011);
        }
        let (kind, index) = variable(fields)?;
        match kind {
            0 => integer(fields[2], 0, 255).map(|_| ())?,
            1 => integer(fields[2], i16::MIN.into(), i16::MAX.into()).map(|_| ())?,
            2 => integer(fields[2], i32::MIN.into(), i32::MAX.into()).map(|_| ())?,
            3 => finite(fields[2]).map(|_| ())?,
            4 => {
                count(fields, 12)?;
                integer(fields[2], 1, 1)?;
                self.place(&fields[3..])?;
            }
            _ if fields[2].len() > 16 => return Err(1013),
            _ => {}
        }
        if kind != 4 {
            count(fields, 3)?;
        }
        self.variables.insert((kind, index), fields[2..].join(","));
        Ok(())
    }
}

/// Operands that the arm cannot follow are out of range, whatever stands in its way.
fn out_of_reach(_reason: MotionError) -> u32 {
    1012
}

fn count(fields: &[&str], expected: usize) -> Result<(), u32> {
    if fields.len() == expected { Ok(()) } else { Err(1011) }
}

fn finite(field: &str) -> Result<f64, u32> {
    field.parse::<f64>().ok().filter(|number| number.is_finite()).ok_or(1012)
}

fn positive(field: &str, most: f64) -> Result<f64, u32> {
    finite(field).and_then(|number| if number > 0.0 && number <= most { Ok(number) } else { Err(1012) })
}

fn integer(field: &str, least: i64, most: i64) -> Result<i64, u32> {
    field.parse::<i64>().ok().filter(|number| (least..=most).contains(number)).ok_or(1012)
}

fn switch(fields: &[&str]) -> Result<bool, u32> {
    count(fields, 1)?;
    Ok(integer(fields[0], 0, 1)? == 1)
}

fn externals(fields: &[&str]) -> Result<(), u32> {
    fields.iter().try_for_each(|field| finite(field).map(|_| ()))
}

/// Address of the first byte, and how many.
fn io_range(fields: &[&str]) -> Result<(u32, u32), u32> {
    let address = integer(fields[0], 0, 999_990)?;
    let bits = integer(fields[1], 8, 256)?;
    if address % 10 != 0 || bits % 8 != 0 {
        return Err(1012);
    }
    Ok((address as u32, bits as u32 / 8))
}

fn variable(fields: &[&str]) -> Result<(u8, u16), u32> {
    let kind = integer(fields[0], 0, 7)?;
    let index = integer(fields[1], 0, INDEX_MAX.into())?;
    if kind == 5 || kind == 6 { Err(1012) } else { Ok((kind as u8, index as u16)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ManualClock;
    use crate::emulator::EmptyTable;
    use proptest::prelude::*;

    fn field() -> impl Strategy<Value = String> {
        prop_oneof![
            4 => (0..10_i64).prop_map(|n| n.to_string()),
            2 => (-400.0..800.0_f64).prop_map(|n| format!("{n:.3}")),
            1 => any::<f64>().prop_map(|n| n.to_string()),
            1 => any::<i64>().prop_map(|n| n.to_string()),
            1 => "[ -~]{0,40}",
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn whatever_it_is_told_it_stays_within_reach_and_answers(
            told in proptest::collection::vec(
                (0..COMMANDS.len(), proptest::collection::vec(field(), 0..18), 0..30_000_u64), 1..12,
            ),
        ) {
            let clock = ManualClock::new();
            let config = EmulatorConfig::default();
            let joints = config.check().unwrap();
            let mut machine = Machine::new(config, joints, Arc::new(clock.clone()), Box::new(EmptyTable));
            for (command, fields, ms) in told {
                let answer = machine.execute(COMMANDS[command], &fields.join(","), None);
                prop_assert!(!matches!(answer, Err(code) if crate::motoman::meaning(code).starts_with("not")), "{answer:?}");
                clock.advance(Duration::from_millis(ms));
                let at = machine.update();
                prop_assert!(at.check().is_ok(), "{at:?}");
                let by_joints = machine.arm.tool_at(&machine.joints);
                // On a line the joints are known at its steps, and between them all but exactly.
                prop_assert!(by_joints.distance_mm(&at) < 0.5, "{at}, by its joints {by_joints}");
            }
        }
    }
}
