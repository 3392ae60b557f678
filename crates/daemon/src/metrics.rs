//! `GET /metrics`: the numbers of the service as Prometheus reads them.
//!
//! Input: the [`Monitor`], looked at when somebody asks, and the times of the stages, counted as they come. Output: the text
//! format of OpenMetrics. Names, labels and what they mean stand in docs/operations.md.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};
use samsod_robot::SequenceState;

use crate::health::{Grade, SharedMonitor};

type StageLabel = [(&'static str, &'static str); 1];

/// Times of the stages, to be counted from any thread.
#[derive(Debug, Clone)]
pub(crate) struct StageTimes(Family<StageLabel, Histogram, fn() -> Histogram>);

impl Default for StageTimes {
    fn default() -> Self {
        // 0.5 ms to 16 s: a stage of a small frame, and the reference saliency of a large one.
        Self(Family::new_with_constructor(|| Histogram::new(exponential_buckets(0.0005, 2.0, 16))))
    }
}

impl StageTimes {
    pub(crate) fn add(&self, stage: &'static str, time: Duration) {
        self.0.get_or_create(&[("stage", stage)]).observe(time.as_secs_f64());
    }
}

/// All metrics of a service.
#[derive(Debug)]
pub(crate) struct Metrics(Registry);

impl Metrics {
    pub(crate) fn new(monitor: SharedMonitor, stages: &StageTimes) -> Self {
        let mut registry = Registry::with_prefix("samsod");
        let help = "Time of a stage of the service for one frame";
        registry.register_with_unit("stage", help, Unit::Seconds, stages.0.clone());
        registry.register_collector(Box::new(Numbers { monitor }));
        Self(registry)
    }

    /// The text, with the type of content it has.
    pub(crate) fn text(&self) -> Result<String, fmt::Error> {
        let mut text = String::new();
        text::encode(&mut text, &self.0)?;
        Ok(text)
    }
}

/// Type of content of [`Metrics::text`].
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// What is looked at when somebody asks.
#[derive(Debug)]
struct Numbers {
    monitor: SharedMonitor,
}

impl Collector for Numbers {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let (counts, to) = (self.monitor.counts(), &mut encoder);
        let (frames, vision) = (counts.frames, counts.vision);
        counter(to, "frames_received", "Frames taken from shared memory", frames.received)?;
        counter(to, "frames_processed", "Frames that went through the vision chain", vision.processed)?;
        counter(to, "frames_dropped", "Frames passed over because a newer one was there", frames.dropped)?;
        let rejected =
            [("header", frames.rejected), ("too_large", vision.too_large), ("wrong_size", vision.wrong_size)];
        counters(to, "frames_rejected", "Frames not accepted", "reason", &rejected)?;
        let failed = [("error", vision.failed), ("panic", vision.panicked)];
        counters(to, "frames_failed", "Frames on which the vision chain failed", "reason", &failed)?;
        counter(to, "frame_clients", "Frame clients that frames came from", frames.publishers)?;
        let objects = [("recognized", vision.recognized), ("unknown", vision.unknown)];
        counter(to, "objects", "Objects found", vision.objects)?;
        counters(to, "parts", "Objects compared with the catalogue", "result", &objects)?;

        let reloads = self.monitor.reloads();
        let reloads = [("done", reloads.done), ("refused", reloads.refused)];
        counters(to, "reloads", "Times that the configuration was read again", "result", &reloads)?;

        let recorder = &self.monitor.recorder;
        let summary = recorder.summary();
        let (written, dropped, not_written) =
            (summary.frames_written, summary.frames_dropped, summary.frames_not_written);
        let recorded = [("written", written), ("dropped", dropped), ("not_written", not_written)];
        counters(to, "recorder_frames", "Frames given to the recorder", "result", &recorded)?;
        let help = "Robot states and log lines lost because the writer lagged behind";
        counter(to, "recorder_lines_dropped", help, summary.lines_dropped)?;
        counter(to, "recorder_commands", "Commands written before they were sent", summary.commands)?;
        let help = "Commands given without being written: on_log_failure is continue";
        counter(to, "recorder_commands_not_written", help, summary.commands_not_written)?;
        let help = "Lines lost to a failure to write";
        counter(to, "recorder_lines_not_written", help, summary.lines_not_written)?;
        counter(to, "recorder_failures", "How often writing has failed", summary.failures)?;
        counter(to, "recorder_files_deleted", "Older recordings that were deleted", summary.files_deleted)?;
        counter(to, "recorder_written_bytes", "Size of the files of this recording", summary.bytes)?;
        gauge(to, "recorder_queue_frames", "Frames that wait for the writer", recorder.waiting_frames() as u64)?;
        if let Some(free) = recorder.free_bytes() {
            gauge(to, "disk_free_bytes", "Free space of the file system of the recordings", free)?;
        }

        if let Ok(robot) = &self.monitor.robot {
            let standing = robot.standing();
            let has_fault = matches!(standing.sequence, Some(SequenceState::Faulted(_)));
            let look = standing.look;
            gauge(to, "robot_connected", "1 if the controller answers", look.connected.into())?;
            gauge(to, "robot_moving", "1 while the robot executes a motion", look.moving.into())?;
            let help = "1 while a fault is latched: the robot stands until an operator resumes";
            gauge(to, "robot_latched", help, (look.latched || has_fault).into())?;
            let c = standing.commands;
            counter(to, "commands_sent", "Commands given to the controller", c.sent)?;
            let ended =
                [("done", c.done), ("not_executed", c.not_executed), ("aborted", c.aborted), ("unknown", c.unknown)];
            counters(to, "commands", "Commands by their outcome", "outcome", &ended)?;
            let p = standing.picks;
            let picks = [("placed", p.placed), ("missed", p.missed), ("not_reached", p.not_reached)];
            counters(to, "picks", "Picks by their result", "result", &picks)?;
        }

        let parts = self.monitor.health().parts;
        let grades = parts.all().map(|(name, part)| (name, u64::from(part.grade == Grade::Fine)));
        gauges(to, "part_ok", "1 if the part of the service is as it should be", None, &grades)?;
        let ages = parts.all().map(|(name, part)| (name, part.pulse_age_ms));
        let ages: Vec<_> = ages.iter().filter_map(|&(name, age)| Some((name, age? as f64 / 1e3))).collect();
        gauges(to, "part_pulse_age", "Since the last sign of life of a part", Some(&Unit::Seconds), &ages)
    }
}

fn counter(encoder: &mut DescriptorEncoder<'_>, name: &str, help: &str, value: u64) -> fmt::Result {
    ConstCounter::new(value).encode(encoder.encode_descriptor(name, help, None, MetricType::Counter)?)
}

fn counters(
    encoder: &mut DescriptorEncoder<'_>,
    name: &str,
    help: &str,
    label: &str,
    values: &[(&str, u64)],
) -> fmt::Result {
    let mut family = encoder.encode_descriptor(name, help, None, MetricType::Counter)?;
    for (of, value) in values {
        ConstCounter::new(*value).encode(family.encode_family(&[(label, *of)])?)?;
    }
    Ok(())
}

fn gauge(encoder: &mut DescriptorEncoder<'_>, name: &str, help: &str, value: u64) -> fmt::Result {
    ConstGauge::new(value).encode(encoder.encode_descriptor(name, help, None, MetricType::Gauge)?)
}

fn gauges<N: prometheus_client::encoding::EncodeGaugeValue + Copy>(
    encoder: &mut DescriptorEncoder<'_>,
    name: &str,
    help: &str,
    unit: Option<&Unit>,
    values: &[(&str, N)],
) -> fmt::Result {
    let mut family = encoder.encode_descriptor(name, help, unit, MetricType::Gauge)?;
    for (part, value) in values {
        ConstGauge::new(*value).encode(family.encode_family(&[("part", *part)])?)?;
    }
    Ok(())
}

/// Metrics that are asked for from another thread.
pub(crate) type SharedMetrics = Arc<Metrics>;
