//! Faults that an emulated controller has, by script.

use serde::{Deserialize, Serialize};

/// What goes wrong, in order of no importance; every rule happens once.
///
/// ```
/// let script: samsod_robot::emulator::FaultScript = toml::from_str(r#"
///     [[fault]]
///     command = "MOVL"              # a command of the table, "acting" for any that moves something; without it any
///     nth = 2                       # of those, counted from 1
///     phase = "answer"              # header, data, answer or mid_motion
///     what = { kind = "delay", ms = 400 }
/// "#)?;
/// script.check()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FaultScript {
    /// The rules.
    #[serde(rename = "fault")]
    pub faults: Vec<FaultRule>,
}

/// One fault, and when it happens.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultRule {
    /// A command, `acting` for any that moves arm or gripper, or any command at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<String>,
    /// At which of these commands, counted from 1.
    #[serde(default = "first")]
    pub nth: u64,
    /// When in the course of that command.
    pub phase: FaultPhase,
    /// With `mid_motion`: share of the motion that was made, 0 to 1.
    #[serde(default = "half")]
    pub share: f64,
    /// What happens.
    pub what: FaultKind,
}

fn first() -> u64 {
    1
}

fn half() -> f64 {
    0.5
}

/// When in the course of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultPhase {
    /// The header has come and is not answered yet.
    Header,
    /// The whole command has come and is not executed yet.
    Data,
    /// The command is executed and not answered yet.
    Answer,
    /// While the motion that the command began is made. What happens to the connection then shows at the next command.
    MidMotion,
}

/// What happens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum FaultKind {
    /// The connection is closed.
    Close,
    /// The connection is reset.
    Reset,
    /// The controller goes on after this time only; in real time, whatever the clock.
    Delay {
        /// Time, ms.
        ms: u64,
    },
    /// Nothing is answered any more on this connection, and nothing executed.
    NeverAnswer,
    /// The reply comes byte by byte.
    OneByteSegments,
    /// The reply to the header and the answer come in one segment; without effect on commands with data.
    Coalesce,
    /// The reply comes twice, in one segment.
    Twice,
    /// The reply ends with a lone CR.
    LoneCr,
    /// The connection is closed within the reply.
    Truncate,
    /// A byte that is no ASCII in the reply.
    NonAscii,
    /// A reply without an end.
    TooLong,
    /// The emergency stop is pressed.
    EmergencyStop,
    /// Servo power goes off.
    ServoOff,
    /// An alarm is raised.
    Alarm {
        /// Its code.
        code: u32,
    },
    /// An error is raised.
    Error {
        /// Its code.
        code: u32,
    },
    /// Hold by an outside signal.
    ExternalHold,
    /// The key switch is turned to teach.
    Teach,
    /// The motion goes on but never arrives.
    Stall,
    /// The motion ends short without a word.
    StopShort,
    /// Another host connects and gives a motion of its own, 20 mm upwards.
    SecondClient,
}

/// Commands that move arm or gripper.
pub(super) const ACTING: [&str; 6] = ["MOVL", "MOVJ", "IMOV", "PMOVJ", "START", "IOWRITE"];

/// Why a script is none.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("fault {number}: {key} is {value}; it must be {allowed}")]
pub struct FaultScriptError {
    /// Which rule, counted from 1.
    pub number: usize,
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// What is allowed.
    pub allowed: &'static str,
}

impl FaultScript {
    /// Checks every rule.
    ///
    /// # Errors
    /// [`FaultScriptError`] names the first value that is not allowed.
    pub fn check(&self) -> Result<(), FaultScriptError> {
        for (number, rule) in (1..).zip(&self.faults) {
            let wrong = |key, value, allowed| Err(FaultScriptError { number, key, value, allowed });
            if rule.nth == 0 {
                return wrong("nth", "0".into(), "at least 1");
            }
            if !(0.0..1.0).contains(&rule.share) {
                return wrong("share", rule.share.to_string(), "at least 0 and below 1");
            }
            match rule.command.as_deref() {
                Some(name) if name != "acting" && !super::machine::COMMANDS.contains(&name) => {
                    return wrong("command", format!("{name:?}"), "a command of the table, or \"acting\"");
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Takes out the rules that happen at this command, and counts it for the others.
    pub(super) fn take(&mut self, command: &str) -> Vec<FaultRule> {
        let mut due = Vec::new();
        self.faults.retain_mut(|rule| {
            let counts = match rule.command.as_deref() {
                None => true,
                Some("acting") => ACTING.contains(&command),
                Some(name) => name == command,
            };
            if counts {
                rule.nth = rule.nth.saturating_sub(1);
                if rule.nth == 0 {
                    due.push(rule.clone());
                    return false;
                }
            }
            true
        });
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rule_happens_once_at_the_command_that_it_counts_to() {
        let text = r#"
            [[fault]]
            command = "acting"
            nth = 2
            phase = "header"
            what = { kind = "close" }
            [[fault]]
            phase = "mid_motion"
            share = 0.25
            what = { kind = "alarm", code = 4107 }
        "#;
        let mut script: FaultScript = toml::from_str(text).unwrap();
        script.check().unwrap();
        let kinds = |rules: Vec<FaultRule>| rules.into_iter().map(|rule| rule.what).collect::<Vec<_>>();
        assert_eq!(kinds(script.take("RSTATS")), [FaultKind::Alarm { code: 4107 }]);
        assert_eq!(kinds(script.take("MOVJ")), []);
        assert_eq!(kinds(script.take("LOADV")), []);
        assert_eq!(kinds(script.take("IOWRITE")), [FaultKind::Close]);
        assert_eq!(kinds(script.take("MOVJ")), []);
    }

    #[test]
    fn a_script_that_cannot_happen_names_rule_and_key() {
        let cases = [
            ("command = \"MOVX\"\nphase = \"data\"", "fault 1: command is \"MOVX\"; it must be a command of the table"),
            ("nth = 0\nphase = \"data\"", "fault 1: nth is 0"),
            ("share = 1.5\nphase = \"mid_motion\"", "fault 1: share is 1.5"),
        ];
        for (rule, message) in cases {
            let text = format!("[[fault]]\n{rule}\nwhat = {{ kind = \"close\" }}");
            let script: FaultScript = toml::from_str(&text).unwrap();
            let error = script.check().unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
    }
}
