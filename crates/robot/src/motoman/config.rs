//! Configuration of a [`Motoman`](super::Motoman), as it stands in a TOML file.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::command::{Terminator, is_job_name};
use super::session::SessionOptions;
use crate::FollowOptions;

/// How to reach a controller, and what is wired to it. Every key has a default except the address of a real robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct MotomanConfig {
    /// `host` or `host:port`; without a port it is 80.
    pub address: String,
    /// End of data lines, `cr` or `crlf`.
    pub data_terminator: Terminator,
    /// Commands that one connection serves: -1 for no limit, or 2 to 32767.
    pub keep_alive: i32,
    /// Coordinate system that poses are in: 0 base, 1 robot, 2 to 65 user.
    pub coordinate_system: u8,
    /// Tool number, 0 to 63.
    pub tool: u8,
    /// Type bits of the poses that are sent, 0 to 63; without it those that the arm has at the time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub figure: Option<u8>,
    /// Time to connect, ms.
    pub connect_timeout_ms: u64,
    /// Time for the answer to the start line, ms.
    pub greeting_timeout_ms: u64,
    /// Time for the answer to a header, ms.
    pub header_timeout_ms: u64,
    /// Time for the answer to a command, ms.
    pub answer_timeout_ms: u64,
    /// Time between polls of a command, 50 to 100 ms.
    pub poll_interval_ms: u64,
    /// Time that the controller may take from accepting a motion to running it, ms.
    pub start_grace_ms: u64,
    /// Distance to the target at which a motion has arrived, mm.
    pub tolerance_mm: f64,
    /// Angle to the target at which a motion has arrived, deg.
    pub tolerance_deg: f64,
    /// Greatest speed of a linear motion that is sent, mm/s.
    pub linear_speed_max_mm_s: f64,
    /// Wait after the first failed attempt to connect, ms; it doubles with each.
    pub reconnect_least_ms: u64,
    /// Greatest wait between attempts to connect, ms.
    pub reconnect_most_ms: u64,
    /// How motions are given.
    pub mode: Mode,
    /// Needed with `mode = "job"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub job: Option<JobConfig>,
    /// What works the gripper.
    pub gripper: GripperConfig,
    /// Time that the gripper takes, ms.
    pub gripper_time_ms: u64,
    /// Bit that is set while the gripper holds something.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_sensor: Option<Signal>,
    /// Bit that is set while the emergency stop is pressed. Without it an emergency stop shows as servo power off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub emergency_stop: Option<Signal>,
}

/// How motions are given.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// As MOVJ and MOVL.
    #[default]
    Direct,
    /// As variables for a taught job, which is then started.
    Job,
}

/// The taught job of `mode = "job"`, and the variables that it reads.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct JobConfig {
    /// Name of the job that makes one motion; it must not call others.
    pub name: String,
    /// P variable: the target.
    pub target_variable: u16,
    /// I variable: the speed, in 0.1 mm/s or 0.01 %.
    pub speed_variable: u16,
    /// B variable: 1 for a joint motion, 2 for a linear one.
    pub kind_variable: u16,
}

/// What works the gripper.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum GripperConfig {
    /// Network inputs of the controller.
    Io {
        /// Address of the first of eight bits; ends in 0.
        start_address: u32,
        /// Bits that open it.
        open_bits: u8,
        /// Bits that close it.
        close_bits: u8,
    },
    /// Taught jobs.
    Jobs {
        /// Job that opens it.
        open_job: String,
        /// Job that closes it.
        close_job: String,
    },
}

/// One bit that the controller can be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Signal {
    /// Address of the first of eight bits; ends in 0.
    pub start_address: u32,
    /// Which of the eight, 0 to 7.
    pub bit: u8,
    /// Whether it is set by a 0.
    #[serde(default)]
    pub inverted: bool,
}

impl Default for MotomanConfig {
    fn default() -> Self {
        Self {
            address: "192.168.255.1:80".into(),
            data_terminator: Terminator::Cr,
            keep_alive: -1,
            coordinate_system: 0,
            tool: 0,
            figure: None,
            connect_timeout_ms: 2000,
            greeting_timeout_ms: 2000,
            header_timeout_ms: 1000,
            answer_timeout_ms: 1000,
            poll_interval_ms: 50,
            start_grace_ms: 300,
            tolerance_mm: 0.5,
            tolerance_deg: 0.5,
            linear_speed_max_mm_s: 1500.0,
            reconnect_least_ms: 250,
            reconnect_most_ms: 5000,
            mode: Mode::Direct,
            job: None,
            gripper: GripperConfig::Io { start_address: 27010, open_bits: 1, close_bits: 2 },
            gripper_time_ms: 300,
            part_sensor: None,
            emergency_stop: None,
        }
    }
}

/// Why a configuration is none.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key} is {value}; it must be {allowed}")]
pub struct MotomanConfigError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// What is allowed.
    pub allowed: &'static str,
}

impl MotomanConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`MotomanConfigError`] names the first key whose value is not allowed.
    pub fn check(&self) -> Result<(), MotomanConfigError> {
        let require = |good: bool, key, value: &dyn std::fmt::Display, allowed| {
            if good { Ok(()) } else { Err(MotomanConfigError { key, value: value.to_string(), allowed }) }
        };
        let host = self.address.rsplit_once(':').map_or(&*self.address, |(host, _)| host);
        let port_is_good = port(&self.address).is_none_or(|port| port.parse::<u16>().is_ok_and(|port| port > 0));
        let address_is_good = !host.is_empty() && !self.address.contains(char::is_whitespace) && port_is_good;
        let quoted = format!("{:?}", self.address);
        require(address_is_good, "address", &quoted, "a host, or host:port with a port of 1 to 65535")?;
        let keep_alive_is_good = self.keep_alive == -1 || (2..=32767).contains(&self.keep_alive);
        require(keep_alive_is_good, "keep_alive", &self.keep_alive, "-1 or 2 to 32767")?;
        require(self.coordinate_system <= 65, "coordinate_system", &self.coordinate_system, "0 to 65")?;
        require(self.tool <= 63, "tool", &self.tool, "0 to 63")?;
        let figure = self.figure.unwrap_or(0);
        require(figure <= 63, "figure", &figure, "0 to 63")?;
        for (key, value) in [
            ("connect_timeout_ms", self.connect_timeout_ms),
            ("greeting_timeout_ms", self.greeting_timeout_ms),
            ("header_timeout_ms", self.header_timeout_ms),
            ("answer_timeout_ms", self.answer_timeout_ms),
        ] {
            require((1..=60_000).contains(&value), key, &value, "1 to 60000")?;
        }
        require((50..=100).contains(&self.poll_interval_ms), "poll_interval_ms", &self.poll_interval_ms, "50 to 100")?;
        require(self.start_grace_ms <= 5000, "start_grace_ms", &self.start_grace_ms, "0 to 5000")?;
        require(self.gripper_time_ms <= 60_000, "gripper_time_ms", &self.gripper_time_ms, "0 to 60000")?;
        // Written so that NaN is refused.
        for (key, value, most, allowed) in [
            ("tolerance_mm", self.tolerance_mm, 10.0, "above 0 and at most 10"),
            ("tolerance_deg", self.tolerance_deg, 10.0, "above 0 and at most 10"),
            ("linear_speed_max_mm_s", self.linear_speed_max_mm_s, 1500.0, "above 0 and at most 1500"),
        ] {
            require(value > 0.0 && value <= most, key, &value, allowed)?;
        }
        let least = self.reconnect_least_ms;
        require((250..=5000).contains(&least), "reconnect_least_ms", &least, "250 to 5000")?;
        let most = self.reconnect_most_ms;
        require((least..=5000).contains(&most), "reconnect_most_ms", &most, "reconnect_least_ms to 5000")?;
        self.check_jobs()?;
        self.check_io()
    }

    fn check_jobs(&self) -> Result<(), MotomanConfigError> {
        let mut jobs = Vec::new();
        match (&self.job, self.mode) {
            (None, Mode::Job) => {
                let allowed = "a table with name, target_variable, speed_variable and kind_variable when mode is job";
                return Err(MotomanConfigError { key: "job", value: "missing".into(), allowed });
            }
            (Some(job), _) => jobs.push(("job.name", &job.name)),
            (None, Mode::Direct) => {}
        }
        if let GripperConfig::Jobs { open_job, close_job } = &self.gripper {
            jobs.extend([("gripper.jobs.open_job", open_job), ("gripper.jobs.close_job", close_job)]);
        }
        match jobs.into_iter().find(|(_, name)| !is_job_name(name)) {
            Some((key, name)) => Err(MotomanConfigError {
                key,
                value: format!("{name:?}"),
                allowed: "1 to 32 printable ASCII characters, no comma, no space",
            }),
            None => Ok(()),
        }
    }

    fn check_io(&self) -> Result<(), MotomanConfigError> {
        let mut addresses = Vec::new();
        if let GripperConfig::Io { start_address, open_bits, close_bits } = self.gripper {
            if open_bits == close_bits {
                let (key, value) = ("gripper.io.close_bits", close_bits.to_string());
                return Err(MotomanConfigError { key, value, allowed: "other than open_bits" });
            }
            addresses.push(("gripper.io.start_address", start_address));
        }
        for (address_key, bit_key, signal) in [
            ("part_sensor.start_address", "part_sensor.bit", self.part_sensor),
            ("emergency_stop.start_address", "emergency_stop.bit", self.emergency_stop),
        ] {
            let Some(signal) = signal else { continue };
            addresses.push((address_key, signal.start_address));
            if signal.bit > 7 {
                let value = signal.bit.to_string();
                return Err(MotomanConfigError { key: bit_key, value, allowed: "0 to 7" });
            }
        }
        match addresses.into_iter().find(|(_, address)| !address.is_multiple_of(10)) {
            Some((key, address)) => {
                Err(MotomanConfigError { key, value: address.to_string(), allowed: "a multiple of 10" })
            }
            None => Ok(()),
        }
    }

    /// How to follow a motion over `distance_mm` at `speed_mm_s` with this controller's poll interval.
    pub fn follow_options(&self, distance_mm: f64, speed_mm_s: f64) -> FollowOptions {
        let interval = Duration::from_millis(self.poll_interval_ms);
        FollowOptions { interval, ..FollowOptions::for_motion(distance_mm, speed_mm_s) }
    }

    pub(crate) fn host_and_port(&self) -> String {
        if port(&self.address).is_some() { self.address.clone() } else { format!("{}:80", self.address) }
    }

    pub(crate) fn session_options(&self) -> SessionOptions {
        SessionOptions {
            keep_alive: self.keep_alive,
            greeting_timeout: Duration::from_millis(self.greeting_timeout_ms),
            header_timeout: Duration::from_millis(self.header_timeout_ms),
            answer_timeout: Duration::from_millis(self.answer_timeout_ms),
        }
    }
}

/// The port of `host:port`; a colon within the brackets of an IPv6 address is none.
fn port(address: &str) -> Option<&str> {
    address.rsplit_once(':').map(|(_, port)| port).filter(|port| !port.contains(']'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_needs_only_an_address_and_is_printed_back() {
        let config: MotomanConfig = toml::from_str("address = \"10.0.0.5\"").unwrap();
        config.check().unwrap();
        assert_eq!(config.host_and_port(), "10.0.0.5:80");
        let printed = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<MotomanConfig>(&printed).unwrap(), config);
        assert!(toml::from_str::<MotomanConfig>("adress = \"x\"").unwrap_err().to_string().contains("adress"));
    }

    #[test]
    fn motions_are_followed_at_its_interval_and_to_their_deadline() {
        let config = MotomanConfig { poll_interval_ms: 80, ..MotomanConfig::default() };
        let options = config.follow_options(300.0, 100.0);
        assert_eq!((options.interval, options.deadline), (Duration::from_millis(80), Duration::from_millis(6500)));
    }

    #[test]
    fn every_table_can_be_written() {
        let text = r#"
            address = "[::1]:8080"
            data_terminator = "crlf"
            keep_alive = 200
            mode = "job"
            job = { name = "SAMSOD-MOVE", target_variable = 10, speed_variable = 11, kind_variable = 12 }
            gripper = { jobs = { open_job = "GRIP-OPEN", close_job = "GRIP-CLOSE" } }
            part_sensor = { start_address = 20030, bit = 4 }
            emergency_stop = { start_address = 80020, bit = 5, inverted = true }
        "#;
        let config: MotomanConfig = toml::from_str(text).unwrap();
        config.check().unwrap();
        assert_eq!(config.host_and_port(), "[::1]:8080");
        assert_eq!(MotomanConfig { address: "[::1]".into(), ..config }.host_and_port(), "[::1]:80");
    }

    #[test]
    fn what_is_not_allowed_is_named_with_its_value_and_what_is() {
        let cases = [
            ("address = \"\"", "address is \"\"; it must be a host"),
            ("address = \"robot:0\"", "address is \"robot:0\""),
            ("address = \"robot:99999\"", "address is \"robot:99999\""),
            ("keep_alive = 1", "keep_alive is 1; it must be -1 or 2 to 32767"),
            ("coordinate_system = 66", "coordinate_system is 66; it must be 0 to 65"),
            ("tool = 64", "tool is 64; it must be 0 to 63"),
            ("figure = 64", "figure is 64; it must be 0 to 63"),
            ("answer_timeout_ms = 0", "answer_timeout_ms is 0; it must be 1 to 60000"),
            ("poll_interval_ms = 101", "poll_interval_ms is 101; it must be 50 to 100"),
            ("tolerance_mm = nan", "tolerance_mm is NaN; it must be above 0 and at most 10"),
            ("linear_speed_max_mm_s = -1", "linear_speed_max_mm_s is -1"),
            ("reconnect_least_ms = 10", "reconnect_least_ms is 10; it must be 250 to 5000"),
            ("reconnect_most_ms = 249", "reconnect_most_ms is 249; it must be reconnect_least_ms to 5000"),
            ("mode = \"job\"", "job is missing; it must be a table"),
            ("gripper = { jobs = { open_job = \"A B\", close_job = \"C\" } }", "gripper.jobs.open_job is \"A B\""),
            (
                "gripper = { io = { start_address = 27010, open_bits = 1, close_bits = 1 } }",
                "gripper.io.close_bits is 1; it must be other than open_bits",
            ),
            ("part_sensor = { start_address = 20031, bit = 1 }", "part_sensor.start_address is 20031"),
            ("emergency_stop = { start_address = 20030, bit = 8 }", "emergency_stop.bit is 8; it must be 0 to 7"),
        ];
        for (line, message) in cases {
            let config: MotomanConfig = toml::from_str(line).unwrap();
            let error = config.check().unwrap_err().to_string();
            assert!(error.starts_with(message), "{line}: {error}");
        }
    }
}
