//! What `samsodd` is called with: in the library, because `samsod` writes the manual pages of both.

use std::path::PathBuf;

use clap::Parser;

/// Vision service of a robot cell: waits for frames in shared memory, finds what is salient, records every stage and
/// sends the robot.
///
/// SIGTERM and SIGINT end it within two seconds: no new command is given, a motion in flight is put on hold, the recording
/// is closed and a table printed. A second signal ends it at once.
///
/// SIGHUP has it read the configuration again: vision and robot go on with it when no motion is under way. A file that is
/// wrong, or that changes what needs a restart, is refused in the log, and the old one stays in force.
///
/// Exit codes: 0 ended as asked, 1 failed, 2 bad configuration or arguments, 3 the recording lacks something,
/// 4 another samsodd serves the cell, 5 the robot stands (with --until-jig-is-full).
#[derive(Debug, Parser)]
#[command(name = "samsodd", version, verbatim_doc_comment)]
pub struct DaemonArguments {
    /// Configuration of the cell, TOML.
    #[arg(long, value_name = "FILE", required_unless_present = "config_schema")]
    pub config: Option<PathBuf>,
    /// Print the configuration in force as TOML, and end.
    #[arg(long)]
    pub check_config: bool,
    /// Print the JSON schema of the configuration, for editors and other programs, and end.
    #[arg(long)]
    pub config_schema: bool,
    /// End after so many processed frames.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// End when the jig is full, or when a fault is latched (exit code 5).
    #[arg(long)]
    pub until_jig_is_full: bool,
}
