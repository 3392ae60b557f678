//! What the robot has made of a table: every pick, and whether the jig is as it should be.
//!
//! In: the table file as the simulated robot left it. Out: a [`Score`], whose last line says it all.

use std::fmt;
use std::path::Path;

use samsod_robot::{PartTableError, TableState, Whereabouts};

/// What the robot has made of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    state: TableState,
}

impl Score {
    /// Reads a table.
    ///
    /// # Errors
    /// [`PartTableError`]
    pub fn read(path: &Path) -> Result<Self, PartTableError> {
        Ok(Self { state: TableState::read(path)? })
    }

    /// Whether every part was placed, none was missed, and nothing collided.
    pub fn is_perfect(&self) -> bool {
        let TableState { parts, picks, collisions, .. } = &self.state;
        let placed = parts.iter().all(|part| part.whereabouts == Whereabouts::Jig);
        placed && collisions.is_empty() && picks.iter().all(|pick| pick.held)
    }
}

impl fmt::Display for Score {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TableState { parts, picks, collisions, .. } = &self.state;
        writeln!(f, "{:<18} {:>8} {:>10} {:>10}", "pick", "result", "error mm", "error deg")?;
        for pick in picks {
            let part = pick.part.as_deref().unwrap_or("nothing");
            let result = if pick.held { "held" } else { "missed" };
            writeln!(f, "{part:<18} {result:>8} {:>10.2} {:>10.2}", pick.error_mm, pick.error_deg)?;
        }
        for part in parts.iter().filter(|part| part.whereabouts != Whereabouts::Jig) {
            let place = match part.whereabouts {
                Whereabouts::Gripper => "in the gripper",
                Whereabouts::Dropped => "dropped",
                _ => "on the table",
            };
            writeln!(f, "{} is {place}", part.name)?;
        }
        for collision in collisions {
            writeln!(f, "{:?} met {} with the tool at {}", collision.by, collision.part, collision.tool)?;
        }
        let placed = parts.iter().filter(|part| part.whereabouts == Whereabouts::Jig).count();
        let worst = picks.iter().filter(|pick| pick.held).map(|pick| pick.error_mm).fold(0.0, f64::max);
        let missed = picks.iter().filter(|pick| !pick.held).count();
        if missed > 0 {
            writeln!(f, "{missed} picks missed")?;
        }
        let (count, met) = (parts.len(), collisions.len());
        write!(f, "placed {placed} of {count}, {met} collisions, worst pick error {worst:.2} mm")
    }
}
