//! What differs between two configurations, key by key, for the log and for those who must be told.

use std::collections::BTreeSet;
use std::fmt;

use toml::{Table, Value};

use crate::config::Config;

/// A key whose value differs.
#[derive(Debug, Clone, PartialEq)]
pub struct ConfigChange {
    /// Sections and key with points between them, e.g. `robot.limits.score_min`.
    pub key: String,
    /// The value before; none if it was not set.
    pub before: Option<Value>,
    /// The value after; none if it is not set.
    pub after: Option<Value>,
}

impl fmt::Display for ConfigChange {
    /// `[robot.limits] score_min: 0.5 -> 0.6`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.key.rsplit_once('.') {
            Some((section, key)) => write!(f, "[{section}] {key}: ")?,
            None => write!(f, "[{}]: ", self.key)?,
        }
        let text = |value: &Option<Value>| match value {
            None => "not set".to_owned(),
            // A number of 32 bits as it is written, without the digits that 64 add.
            Some(Value::Float(number)) if f64::from(*number as f32) == *number => format!("{:?}", *number as f32),
            Some(value) => value.to_string(),
        };
        write!(f, "{} -> {}", text(&self.before), text(&self.after))
    }
}

/// The keys that differ, in the order of their names.
///
/// # Errors
/// A configuration cannot be written as TOML.
pub fn config_changes(before: &Config, after: &Config) -> Result<Vec<ConfigChange>, toml::ser::Error> {
    let (before, after) = (Value::try_from(before)?, Value::try_from(after)?);
    let mut changes = Vec::new();
    compare("", Some(&before), Some(&after), &mut changes);
    Ok(changes)
}

fn compare(key: &str, before: Option<&Value>, after: Option<&Value>, changes: &mut Vec<ConfigChange>) {
    if before == after {
        return;
    }
    // A section that is not there has no keys.
    let are_sections = [before, after].into_iter().flatten().all(Value::is_table);
    if are_sections {
        let (before, after) = (before.and_then(Value::as_table), after.and_then(Value::as_table));
        let names = [before, after].into_iter().flatten().flat_map(|table| table.keys());
        for name in names.collect::<BTreeSet<&String>>() {
            let inner = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            let of = |table: Option<&Table>| table.and_then(|table| table.get(name)).cloned();
            compare(&inner, of(before).as_ref(), of(after).as_ref(), changes);
        }
    } else {
        changes.push(ConfigChange { key: key.to_owned(), before: before.cloned(), after: after.cloned() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn changes(before: &str, after: &str) -> Vec<String> {
        let config = |text: &str| toml::from_str::<Config>(text).unwrap();
        let changes = config_changes(&config(before), &config(after)).unwrap();
        changes.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn every_key_that_differs_is_named_with_both_values() {
        assert!(changes("[segment]\nrange_bandwidth = 4.0", "").is_empty(), "the default");
        let after = "[segment]\nmin_area_px = 20\nrange_bandwidth = 5.5\n[robot.limits]\nscore_min = 0.75\n[recognize]\nmin_score = 0.6\n\
                     [saliency]\nscales = { object_sizes_px = [60.0] }\n[view]\n";
        assert_eq!(
            changes("", after),
            [
                "[recognize] min_score: 0.5 -> 0.6",
                "[robot.limits] score_min: 0.5 -> 0.75",
                "[saliency] scales: \"generic\" -> { object_sizes_px = [60.0] }",
                "[segment] min_area_px: not set -> 20",
                "[segment] range_bandwidth: 4.0 -> 5.5",
                "[view] mm_per_px: not set -> 0.4",
                "[view] origin_px: not set -> [-625.0, 479.0]",
            ]
        );
        assert_eq!(changes(after, "").len(), 7);
        let jig = "[jig]\norder = [{ part = \"a\", x_mm = 1.0, y_mm = 2.0 }]";
        assert!(changes("", jig)[0].starts_with("[jig] order: [] -> [{"), "{:?}", changes("", jig));
    }
}
