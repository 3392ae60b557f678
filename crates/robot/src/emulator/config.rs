//! Configuration of an emulated controller, as it stands in a TOML file.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::script::{FaultScript, FaultScriptError};
use crate::motoman::{JobConfig, Signal};
use crate::{ArmModel, Joints, MotionError, Pose};

/// How an emulated controller behaves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EmulatorConfig {
    /// Where it listens; port 0 takes a free one.
    pub listen: String,
    /// Product word and version of its greeting.
    pub product: String,
    /// Whether every line that it sends ends with a lone CR.
    pub lone_cr: bool,
    /// Whether reply to a header and answer come in one segment, where no data lies between.
    pub coalesce: bool,
    /// Where the tool is at the start, `base_from_tool`.
    pub home: Pose,
    /// Type bits that it tells.
    pub figure: u8,
    /// Length of the tool of the arm, an MH5: from the flange straight out to the tool centre point, mm.
    pub tool_length_mm: f64,
    /// Pulses that a joint counts for a degree: S, L, U, R, B, T. A stand-in: those of a real arm follow from its gears and are
    /// among the parameters of its controller.
    pub pulses_per_deg: [f64; 6],
    /// Address of the eight network inputs that work the gripper; ends in 0.
    pub gripper_address: u32,
    /// Their bits that open it.
    pub gripper_open_bits: u8,
    /// Their bits that close it.
    pub gripper_close_bits: u8,
    /// Job that opens the gripper.
    pub gripper_open_job: String,
    /// Job that closes the gripper.
    pub gripper_close_job: String,
    /// Time that the gripper takes, ms.
    pub gripper_time_ms: u64,
    /// Bit that is set while the gripper holds something.
    pub part_sensor: Signal,
    /// Bit that is set while the emergency stop is pressed.
    pub emergency_stop: Signal,
    /// The job that makes one motion.
    pub move_job: JobConfig,
    /// Faults.
    pub script: FaultScript,
    /// File for the journal, one line of JSON for each command.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub journal_file: Option<PathBuf>,
}

impl Default for EmulatorConfig {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:0".into(),
            product: "DX Information Server(4.00)".into(),
            lone_cr: false,
            coalesce: false,
            home: Pose::gripper_down(400.0, 0.0, 400.0, 0.0),
            figure: 0,
            tool_length_mm: 100.0,
            pulses_per_deg: [1000.0; 6],
            gripper_address: 27010,
            gripper_open_bits: 1,
            gripper_close_bits: 2,
            gripper_open_job: "GRIP-OPEN".into(),
            gripper_close_job: "GRIP-CLOSE".into(),
            gripper_time_ms: 200,
            part_sensor: Signal { start_address: 20030, bit: 4, inverted: false },
            emergency_stop: Signal { start_address: 80020, bit: 5, inverted: false },
            move_job: JobConfig {
                name: "SAMSOD-MOVE".into(),
                target_variable: 10,
                speed_variable: 11,
                kind_variable: 12,
            },
            script: FaultScript::default(),
            journal_file: None,
        }
    }
}

/// Why a controller cannot be emulated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EmulatorError {
    /// A number is out of range.
    #[error("{key} is {value}; it must be {allowed}")]
    OutOfRange {
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The home pose cannot be reached.
    #[error("home: {0}")]
    Home(#[source] Box<MotionError>),
    /// The script is none.
    #[error(transparent)]
    Script(#[from] FaultScriptError),
    /// It cannot listen there.
    #[error("cannot listen on {listen:?}: {cause}")]
    Listen {
        /// Where.
        listen: String,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// The journal cannot be written.
    #[error("cannot write the journal {path:?}: {cause}")]
    Journal {
        /// Its file.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
}

impl EmulatorConfig {
    /// Checks every value. Returns the joints at home.
    pub(super) fn check(&self) -> Result<Joints, EmulatorError> {
        let (key, value) = ("tool_length_mm", self.tool_length_mm);
        if !(0.0..=1000.0).contains(&value) {
            return Err(EmulatorError::OutOfRange { key, value, allowed: "0 to 1000" });
        }
        for value in self.pulses_per_deg {
            if !(value > 0.0 && value <= 1e6) {
                let key = "pulses_per_deg";
                return Err(EmulatorError::OutOfRange { key, value, allowed: "above 0, at most 1000000" });
            }
        }
        for (key, bit) in [("part_sensor.bit", self.part_sensor.bit), ("emergency_stop.bit", self.emergency_stop.bit)] {
            if bit > 7 {
                return Err(EmulatorError::OutOfRange { key, value: f64::from(bit), allowed: "0 to 7" });
            }
        }
        self.script.check()?;
        let arm = ArmModel::mh5(self.tool_length_mm);
        arm.joints_at(&self.home, &Joints([0.0; 6])).map_err(|e| EmulatorError::Home(Box::new(e)))
    }
}
