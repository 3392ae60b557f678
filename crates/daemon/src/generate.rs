//! Manual pages and shell completions of both programs, written from what clap knows of them.
//!
//! Output, in a folder: `man/samsodd.1`, `man/samsod.1` and a page for each subcommand; `completions/` for bash, zsh and fish;
//! `cell.schema.json`, the schema of the configuration. The package is made of them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use clap::{Command, CommandFactory};
use clap_complete::Shell;

use crate::config_schema;
use crate::daemon_arguments::DaemonArguments;

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to {}: {source}", path.display())]
pub struct GenerateError {
    /// The file, or its folder.
    pub path: PathBuf,
    /// What the system said.
    pub source: io::Error,
}

/// Writes everything for `samsod`, as it is given, and for `samsodd`.
///
/// # Errors
/// [`GenerateError`]
pub fn generate(samsod: &Command, folder: &Path) -> Result<(), GenerateError> {
    let (man, completions) = (folder.join("man"), folder.join("completions"));
    for folder in [&man, &completions] {
        fs::create_dir_all(folder).map_err(|source| GenerateError { path: folder.clone(), source })?;
    }
    for command in [samsod.clone(), DaemonArguments::command()] {
        let name = command.get_name().to_owned();
        clap_mangen::generate_to(command.clone(), &man)
            .map_err(|source| GenerateError { path: man.clone(), source })?;
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            clap_complete::generate_to(shell, &mut command.clone(), &name, &completions)
                .map_err(|source| GenerateError { path: completions.clone(), source })?;
        }
    }
    let schema = folder.join("cell.schema.json");
    fs::write(&schema, config_schema::text()).map_err(|source| GenerateError { path: schema, source })
}
