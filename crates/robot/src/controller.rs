//! The controller trait and one error enum for each of its operations.
//!
//! Every error of an operation that commands the robot tells through `outcome()` what is then known, so that a caller
//! never has to guess whether something moved.

use crate::{CommandId, GripperCommand, Motion, NotReady, Outcome, Pose, PoseError, Progress, Sighting, Status};

/// A robot controller.
///
/// Calls block for one exchange with the controller (milliseconds), never for a motion; `&mut self` keeps one command
/// in flight. A `Controller` is neither armed nor limited: workspace, height, speed and age limits wrap it from outside.
///
/// Ids must grow from command to command (motions and gripper together). That holds across
/// [`connect`](Self::connect) and [`resume`](Self::resume), so that a command from before a fault can never be given
/// again.
pub trait Controller: Send {
    /// A short name for logs: `simulated`, `motoman`.
    fn name(&self) -> &str;

    /// Makes or remakes the connection. It moves nothing, switches no servo on and clears no latched fault.
    ///
    /// # Errors
    /// [`ConnectError`]
    fn connect(&mut self) -> Result<(), ConnectError>;

    /// Reads the status.
    ///
    /// # Errors
    /// [`StatusError`]
    fn status(&mut self) -> Result<Status, StatusError>;

    /// Reads where the tool is, `base_from_tool`.
    ///
    /// # Errors
    /// [`PositionError`]
    fn position(&mut self) -> Result<Pose, PositionError>;

    /// Says what the motions that follow are based on, so that limits can refuse what was seen too long ago or too
    /// doubtfully; `None` when they follow from nothing that was seen. A controller without limits has no use for it.
    fn base_on(&mut self, sighting: Option<Sighting>) {
        let _ = sighting;
    }

    /// Starts a motion. `Ok` means accepted, not arrived: [`poll`](Self::poll) tells the rest.
    ///
    /// The status is read first; the motion is sent only to a controller that is ready.
    ///
    /// # Errors
    /// [`MotionError`]; its `outcome()` says whether the robot may be moving.
    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError>;

    /// Starts to open or close the gripper. `Ok` means accepted; [`poll`](Self::poll) tells when it is done.
    ///
    /// # Errors
    /// [`GripperError`]; its `outcome()` says whether the gripper may be moving.
    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError>;

    /// Reads status and position and says what is known of the last command. Final outcomes stay as they are.
    ///
    /// # Errors
    /// [`PollError`]; the command goes on regardless, so poll again.
    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError>;

    /// Switches hold on, which stops the robot and aborts its motion, or off, which continues nothing.
    ///
    /// # Errors
    /// [`HoldError`]; the robot may then still be moving.
    fn hold(&mut self, on: bool) -> Result<(), HoldError>;

    /// Latches a fault that the caller has found: no command is taken until [`resume`](Self::resume). A fault that is
    /// latched already keeps its reason. Sends nothing; see [`hold`](Self::hold) for that.
    fn latch(&mut self, reason: &str);

    /// Clears a latched fault after an operator has looked. Reads status and position first; resets no alarm and
    /// switches no servo on, that is done at the robot.
    ///
    /// Returns the position that was read back.
    ///
    /// # Errors
    /// [`ResumeError`]; the fault then stays latched.
    fn resume(&mut self) -> Result<Pose, ResumeError>;
}

impl<C: Controller + ?Sized> Controller for Box<C> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn connect(&mut self) -> Result<(), ConnectError> {
        (**self).connect()
    }

    fn status(&mut self) -> Result<Status, StatusError> {
        (**self).status()
    }

    fn position(&mut self) -> Result<Pose, PositionError> {
        (**self).position()
    }

    fn base_on(&mut self, sighting: Option<Sighting>) {
        (**self).base_on(sighting);
    }

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        (**self).start_motion(id, motion)
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        (**self).start_gripper(id, command)
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        (**self).poll(id)
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        (**self).hold(on)
    }

    fn latch(&mut self, reason: &str) {
        (**self).latch(reason);
    }

    fn resume(&mut self) -> Result<Pose, ResumeError> {
        (**self).resume()
    }
}

/// Why there is no connection.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConnectError {
    /// Nobody listens, or the network is down.
    #[error("cannot reach the controller at {address}: {cause}")]
    Unreachable {
        /// Where.
        address: String,
        /// What the system said.
        cause: String,
    },
    /// Somebody answered, but not as the protocol demands.
    #[error("{address} answered {answer:?} to the greeting; is it a robot controller?")]
    WrongGreeting {
        /// Where.
        address: String,
        /// What came, shortened.
        answer: String,
    },
    /// No greeting in time.
    #[error("{address} did not answer the greeting within {timeout_ms} ms")]
    Timeout {
        /// Where.
        address: String,
        /// Time allowed, ms.
        timeout_ms: u64,
    },
    /// An attempt failed shortly before; the next comes too early.
    #[error("{address} is not called again for {wait_ms} ms: the last attempt to connect failed")]
    BackingOff {
        /// Where.
        address: String,
        /// Time to wait, ms.
        wait_ms: u64,
    },
}

/// Why the status could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StatusError {
    /// There is no connection.
    #[error("not connected")]
    NotConnected,
    /// The connection broke or stayed silent.
    #[error("no status from the controller: {cause}")]
    NoAnswer {
        /// What happened.
        cause: String,
    },
    /// The answer could not be understood.
    #[error("the controller answered {answer:?} to a status request")]
    Malformed {
        /// What came, shortened.
        answer: String,
    },
}

/// Why the position could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PositionError {
    /// There is no connection.
    #[error("not connected")]
    NotConnected,
    /// The connection broke or stayed silent.
    #[error("no position from the controller: {cause}")]
    NoAnswer {
        /// What happened.
        cause: String,
    },
    /// The answer could not be understood.
    #[error("the controller answered {answer:?} to a position request")]
    Malformed {
        /// What came, shortened.
        answer: String,
    },
}

/// Why a motion was not accepted, or is not known to be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MotionError {
    /// There is no connection.
    #[error("not connected")]
    NotConnected,
    /// The id was used before.
    #[error("command {id} was given before, the last was {last}; ids must grow")]
    StaleId {
        /// The id.
        id: CommandId,
        /// The last id that was given.
        last: CommandId,
    },
    /// The target is no pose.
    #[error("target: {0}")]
    Target(#[from] PoseError),
    /// The speed is not one.
    #[error("speed {value} {unit} is outside {above} (excluded) to {at_most} {unit}")]
    Speed {
        /// The value given.
        value: f64,
        /// Excluded lower bound.
        above: f64,
        /// Included upper bound.
        at_most: f64,
        /// Unit of all three.
        unit: &'static str,
    },
    /// The robot cannot get there.
    #[error("{target} is out of reach: {quantity} is {value:.1} {unit}, allowed is {least:.1} to {most:.1} {unit}")]
    OutOfReach {
        /// Where it should have gone.
        target: Pose,
        /// What is out of range: of the target, or the worst on the way to it.
        quantity: &'static str,
        /// Its value.
        value: f64,
        /// Least value allowed.
        least: f64,
        /// Greatest value allowed.
        most: f64,
        /// Unit of all three.
        unit: &'static str,
    },
    /// The line passes where the arm cannot follow it: a joint would have to leap.
    #[error(
        "{target} cannot be reached on a straight line: at {at_mm:.0?} mm {joint} would have to turn at {needed_deg_s:.0} deg/s, \
         it can turn at {most_deg_s:.0} deg/s"
    )]
    Singular {
        /// Where it should have gone.
        target: Pose,
        /// Where on the way, mm.
        at_mm: [f64; 3],
        /// Which joint.
        joint: &'static str,
        /// Speed that would be needed there, deg/s.
        needed_deg_s: f64,
        /// Greatest speed of the joint, deg/s.
        most_deg_s: f64,
    },
    /// A limit of the cell forbids it.
    #[error("{limit} is {value}{}; allowed: {allowed}{}", spaced(unit), spaced(unit))]
    Limit {
        /// Which limit.
        limit: &'static str,
        /// The value asked for.
        value: f64,
        /// What is allowed.
        allowed: String,
        /// Unit of both; empty without one.
        unit: &'static str,
    },
    /// The cell may not move its robot.
    #[error("the robot may not be moved: armed = true is missing in the configuration")]
    NotArmed,
    /// An operator wants the robot to stand.
    #[error("an operator has asked for hold")]
    HoldAsked,
    /// The controller is not ready, so nothing was sent.
    #[error("{0}")]
    NotReady(#[from] NotReady),
    /// The controller refused.
    #[error("the controller refused the motion: {code} ({meaning})")]
    Refused {
        /// Code of the refusal.
        code: u32,
        /// What the code means.
        meaning: String,
    },
    /// The connection broke before the command was complete at the controller.
    #[error("the motion was not sent: {cause}")]
    NotSent {
        /// What happened.
        cause: String,
    },
    /// The command was sent and no answer came: it may be executed. The fault is latched.
    #[error("no answer to the motion, the robot may be moving: {cause}")]
    NoAnswer {
        /// What happened.
        cause: String,
    },
}

fn spaced(unit: &str) -> String {
    if unit.is_empty() { String::new() } else { format!(" {unit}") }
}

impl MotionError {
    /// What is known of the motion.
    pub fn outcome(&self) -> Outcome {
        match self {
            Self::NoAnswer { .. } => Outcome::Unknown { reason: self.to_string() },
            _ => Outcome::NotExecuted { reason: self.to_string() },
        }
    }
}

/// Why a gripper command was not accepted, or is not known to be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GripperError {
    /// There is no connection.
    #[error("not connected")]
    NotConnected,
    /// The id was used before.
    #[error("command {id} was given before, the last was {last}; ids must grow")]
    StaleId {
        /// The id.
        id: CommandId,
        /// The last id that was given.
        last: CommandId,
    },
    /// The cell may not move its robot.
    #[error("the gripper may not be moved: armed = true is missing in the configuration")]
    NotArmed,
    /// An operator wants the robot to stand.
    #[error("an operator has asked for hold")]
    HoldAsked,
    /// The controller is not ready, so nothing was sent.
    #[error("{0}")]
    NotReady(#[from] NotReady),
    /// The controller refused.
    #[error("the controller refused the gripper command: {code} ({meaning})")]
    Refused {
        /// Code of the refusal.
        code: u32,
        /// What the code means.
        meaning: String,
    },
    /// The connection broke before the command was complete at the controller.
    #[error("the gripper command was not sent: {cause}")]
    NotSent {
        /// What happened.
        cause: String,
    },
    /// The command was sent and no answer came: it may be executed. The fault is latched.
    #[error("no answer to the gripper command, the gripper may be moving: {cause}")]
    NoAnswer {
        /// What happened.
        cause: String,
    },
}

impl GripperError {
    /// What is known of the command.
    pub fn outcome(&self) -> Outcome {
        match self {
            Self::NoAnswer { .. } => Outcome::Unknown { reason: self.to_string() },
            _ => Outcome::NotExecuted { reason: self.to_string() },
        }
    }
}

/// Why nothing new was learnt of a command.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PollError {
    /// The id is not that of the last command.
    #[error("command {id} is not the last one{}", last.map_or(String::new(), |last| format!(", which is {last}")))]
    NotTheLast {
        /// The id.
        id: CommandId,
        /// The last id that was given, if any.
        last: Option<CommandId>,
    },
    /// The status could not be read.
    #[error(transparent)]
    Status(#[from] StatusError),
    /// The position could not be read.
    #[error(transparent)]
    Position(#[from] PositionError),
}

/// Why hold could not be switched.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum HoldError {
    /// There is no connection.
    #[error("not connected")]
    NotConnected,
    /// The controller refused.
    #[error("the controller refused to switch hold: {code} ({meaning})")]
    Refused {
        /// Code of the refusal.
        code: u32,
        /// What the code means.
        meaning: String,
    },
    /// No answer came; hold may have been switched or not.
    #[error("no answer to hold: {cause}")]
    NoAnswer {
        /// What happened.
        cause: String,
    },
}

/// Why a latched fault stays.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ResumeError {
    /// The status could not be read.
    #[error(transparent)]
    Status(#[from] StatusError),
    /// The position could not be read back.
    #[error(transparent)]
    Position(#[from] PositionError),
    /// What caused the fault still stands, or the robot is still moving.
    #[error("cannot resume: {0}")]
    NotReady(#[from] NotReady),
}
