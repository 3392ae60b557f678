//! What the system tells about this process, the machine and the commit. Linux only; what is absent is `None` or "-".

use std::fs;
use std::process::Command;
use std::thread;
use std::time::{Duration, SystemTime};

/// Date, commit, processor, cores and load, as one line.
pub(crate) fn description() -> String {
    let now = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let date = now.split('T').next().unwrap_or("-");
    let cores = thread::available_parallelism().map_or(0, usize::from);
    let load = fs::read_to_string("/proc/loadavg").ok();
    let load = load.as_deref().and_then(|l| l.split(' ').next()).unwrap_or("-");
    format!("{date}, commit {}, {}, {cores} cores, load {load} at the start", commit(), processor())
}

/// The commit that is checked out, and whether sources differ from it.
fn commit() -> String {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok().filter(|o| o.status.success())?;
        String::from_utf8(output.stdout).ok()
    };
    let Some(hash) = git(&["rev-parse", "--short", "HEAD"]) else { return "-".into() };
    // The root of the repository, for cargo runs benchmarks in the folder of their package. Documents do not count.
    let changed = git(&["status", "--porcelain", "--untracked-files=no", "--", ":/", ":!/docs"]);
    let note = if changed.is_some_and(|c| !c.is_empty()) { " with changes" } else { "" };
    format!("{}{note}", hash.trim())
}

/// The model of the first processor.
fn processor() -> String {
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find(|l| l.starts_with("model name")).and_then(|l| l.split_once(": "));
    model.map_or("-", |(_, name)| name.trim()).into()
}

/// Resident memory of this process, KiB. The figure of `/proc/self/statm` without its unit, the size of a page.
pub(crate) fn resident_kib() -> Option<i64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?.trim().strip_suffix("kB")?.trim().parse().ok()
}

/// Processor time of all threads of this process, to ten milliseconds.
pub(crate) fn processor_time() -> Option<Duration> {
    let stat = fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the program comes second and may hold spaces. Ticks in /proc are hundredths of a second.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<u64>().ok();
    Some(Duration::from_millis((ticks()? + ticks()?) * 10))
}
