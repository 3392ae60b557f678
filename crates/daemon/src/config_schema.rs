//! The JSON schema of the configuration, made from the structs that it is read into.
//!
//! Editors complete and check a cell.toml by it. It knows sections, keys, types and words, and what each is for; values out of range,
//! and files that are missing, are found by `samsodd --check-config` alone.

use schemars::Schema;

use crate::config::Config;

/// The schema of [`Config`], draft 2020-12.
pub fn schema() -> Schema {
    let mut schema = schemars::schema_for!(Config);
    schema.insert("title".to_owned(), "Configuration of samsodd".into());
    schema
}

/// [`schema`] as text.
pub fn text() -> String {
    format!("{:#}\n", schema().as_value())
}
