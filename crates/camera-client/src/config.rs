//! `camera-client.toml`: which camera, how it is set, and which cell gets its frames.
//!
//! Input: TOML. Output: a [`ClientConfig`] in which every value is in its range, or a [`ConfigError`] that names the key, the value
//! and what is allowed. What only the camera knows, such as its longest exposure, is checked against it when it is set up.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use samsod_frame::{CameraId, FrameError, FrameServiceConfig, MAX_SIDE_PX, PixelFormat, ServiceError};
use serde::{Deserialize, Serialize};

/// What `camera-client.toml` holds; every key may be left out.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClientConfig {
    /// Which cell gets the frames.
    pub cell: CellSection,
    /// Which camera, and how it is set.
    pub camera: CameraSection,
    /// GigE Vision alone.
    pub gige: GigeSection,
    /// When a camera is taken for gone, and how it is looked for.
    pub reconnect: ReconnectSection,
    /// What is told on the way.
    pub report: ReportSection,
}

/// `[cell]`: the same values as in samsodd's configuration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CellSection {
    /// `[cell] name` there.
    pub name: String,
    /// `[frames] root_path` there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub root_path: Option<PathBuf>,
    /// `[frames] buffer_frames` there.
    pub buffer_frames: usize,
    /// `[frames] max_subscribers` there.
    pub max_subscribers: usize,
}

impl Default for CellSection {
    fn default() -> Self {
        let FrameServiceConfig { cell, buffer_frames, max_subscribers, .. } = FrameServiceConfig::default();
        Self { name: cell, root_path: None, buffer_frames, max_subscribers }
    }
}

/// How a camera is reached.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Driver {
    /// GigE Vision and USB3 Vision, through Aravis.
    #[default]
    Genicam,
    /// The kernel's, `/dev/video*`.
    V4l,
}

impl fmt::Display for Driver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Genicam => "genicam",
            Self::V4l => "v4l",
        })
    }
}

/// A number, or the word `"auto"`: the camera chooses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AutoOr<T> {
    /// The camera chooses.
    Auto,
    /// This value.
    Value(T),
}

impl<T: Serialize> Serialize for AutoOr<T> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            Self::Value(value) => value.serialize(serializer),
        }
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for AutoOr<T> {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Either<T> {
            Number(T),
            Word(String),
        }
        // The error of an untagged enumeration names neither the value nor what is allowed.
        let expected = "a number of the right kind or \"auto\"";
        match Either::deserialize(deserializer) {
            Ok(Either::Number(value)) => Ok(Self::Value(value)),
            Ok(Either::Word(word)) if word == "auto" => Ok(Self::Auto),
            Ok(Either::Word(word)) => Err(serde::de::Error::custom(format!("{word:?} is not allowed; {expected} is"))),
            Err(_) => Err(serde::de::Error::custom(format!("the value must be {expected}"))),
        }
    }
}

/// `[camera]`: which camera, and how it is set. What is left out stays as the camera has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraSection {
    /// How it is reached.
    pub driver: Driver,
    /// Which one. GenICam: its id as `samsod-camera --list` prints it, its serial number or IP address; empty, the first that is
    /// found. V4L: its file, by default `/dev/video0`.
    pub device: String,
    /// Its name in frames and recordings, at most 31 bytes.
    pub name: String,
    /// How pixels are sent. Without it: the camera's own format if it can be used, else the first that can.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel_format: Option<PixelFormat>,
    /// Width of what is sent, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width_px: Option<u32>,
    /// Height of what is sent, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_px: Option<u32>,
    /// Column of the sensor that is the first of the frame, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset_x_px: Option<u32>,
    /// Row of the sensor that is the first of the frame, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset_y_px: Option<u32>,
    /// Frames a second, without a trigger.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_rate_hz: Option<f64>,
    /// Exposure, microseconds, or `"auto"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_us: Option<AutoOr<f64>>,
    /// Gain in the unit of the camera, mostly dB, or `"auto"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<AutoOr<f64>>,
    /// What starts a frame: `"off"`, the camera itself at its frame rate; or a source of the camera, e.g. `"Line1"`; or
    /// `"Software"`, this client with `trigger_rate_hz`.
    pub trigger: String,
    /// How often the client triggers, with `trigger = "Software"`, Hz.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trigger_rate_hz: Option<f64>,
    /// Frames that may be received while others are sent; each is a slot of shared memory.
    pub buffers: usize,
}

impl Default for CameraSection {
    fn default() -> Self {
        Self {
            driver: Driver::default(),
            device: String::new(),
            name: "camera".to_owned(),
            pixel_format: None,
            width_px: None,
            height_px: None,
            offset_x_px: None,
            offset_y_px: None,
            frame_rate_hz: None,
            exposure_us: None,
            gain: None,
            trigger: "off".to_owned(),
            trigger_rate_hz: None,
            buffers: 4,
        }
    }
}

/// `[gige]`: how frames come through the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GigeSection {
    /// Bytes of a packet with its headers, or `"auto"`: the largest that gets through.
    pub packet_size: AutoOr<u32>,
    /// Pause of the camera between packets, ns, where several share one link. Without it, as the camera has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub packet_delay_ns: Option<u32>,
    /// Whether lost packets are asked for again.
    pub resend: bool,
    /// How long packets may be late before their frame is given up, ms.
    pub frame_retention_ms: u32,
}

impl Default for GigeSection {
    fn default() -> Self {
        Self { packet_size: AutoOr::Auto, packet_delay_ns: None, resend: true, frame_retention_ms: 100 }
    }
}

/// `[reconnect]`: when a camera is taken for gone, and how it is looked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReconnectSection {
    /// Silence after which a camera without a trigger is taken for gone, ms. One with a trigger is asked whether it is there.
    pub silent_after_ms: u64,
    /// First pause between two attempts, ms; it doubles from one to the next.
    pub pause_ms: u64,
    /// Longest pause, ms.
    pub longest_pause_ms: u64,
}

impl Default for ReconnectSection {
    fn default() -> Self {
        Self { silent_after_ms: 1500, pause_ms: 100, longest_pause_ms: 1000 }
    }
}

/// `[report]`: what is told on the way.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReportSection {
    /// Time between two lines `status`, s.
    pub every_s: u64,
    /// Whether they tell which white balance and exposure would fit the table.
    pub advice: bool,
}

impl Default for ReportSection {
    fn default() -> Self {
        Self { every_s: 10, advice: true }
    }
}

/// Why a configuration is not accepted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is not TOML, or has a key or a kind of value that is not known.
    #[error("{}: {source}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        source: Box<toml::de::Error>,
    },
    /// A value is out of range.
    #[error("{key} = {value}; allowed: {allowed}")]
    Value {
        /// Section and key.
        key: &'static str,
        /// The value given.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// The name of the camera does not fit into a header.
    #[error("[camera] name: {0}")]
    Name(#[source] FrameError),
    /// The cell cannot be.
    #[error("[cell]: {0}")]
    Cell(#[source] ServiceError),
}

impl ClientConfig {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`ConfigError`], with what is allowed.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Reads and checks a text; `path` is for messages.
    ///
    /// # Errors
    /// [`ConfigError`], with what is allowed.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text)
            .map_err(|source| ConfigError::Parse { path: path.to_owned(), source: Box::new(source) })?;
        config.check()?;
        Ok(config)
    }

    /// Checks every value that can be checked without the camera.
    ///
    /// # Errors
    /// [`ConfigError`]: the first that is wrong.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.service().check().map_err(ConfigError::Cell)?;
        let camera = &self.camera;
        CameraId::new(&camera.name).map_err(ConfigError::Name)?;
        for (key, value) in [("[camera] width_px", camera.width_px), ("[camera] height_px", camera.height_px)] {
            optional(key, value, 1, MAX_SIDE_PX)?;
        }
        for (key, value) in [("[camera] offset_x_px", camera.offset_x_px), ("[camera] offset_y_px", camera.offset_y_px)]
        {
            optional(key, value, 0, 1 << 20)?;
        }
        optional("[camera] frame_rate_hz", camera.frame_rate_hz, 0.001, 10_000.0)?;
        if let Some(AutoOr::Value(exposure_us)) = camera.exposure_us {
            within("[camera] exposure_us", exposure_us, 0.1, 60e6)?;
        }
        if let Some(AutoOr::Value(gain)) = camera.gain {
            within("[camera] gain", gain, -100.0, 1e5)?;
        }
        within("[camera] buffers", camera.buffers, 2, 64)?;
        if camera.trigger.is_empty() {
            return Err(refused("[camera] trigger", "\"\"", "\"off\" or a trigger source of the camera".to_owned()));
        }
        match (camera.triggers_itself(), camera.trigger_rate_hz) {
            (true, None) => {
                let allowed = "0.001 to 1000 with trigger = \"Software\"".to_owned();
                return Err(refused("[camera] trigger_rate_hz", "not given", allowed));
            }
            (true, Some(rate)) => within("[camera] trigger_rate_hz", rate, 0.001, 1000.0)?,
            (false, None) => {}
            (false, Some(rate)) => {
                let allowed = format!("with trigger = \"Software\" alone; it is {:?}", camera.trigger);
                return Err(refused("[camera] trigger_rate_hz", rate, allowed));
            }
        }
        if let AutoOr::Value(bytes) = self.gige.packet_size {
            within("[gige] packet_size", bytes, 220, 16_384)?;
        }
        optional("[gige] packet_delay_ns", self.gige.packet_delay_ns, 0, 1_000_000_000)?;
        within("[gige] frame_retention_ms", self.gige.frame_retention_ms, 1, 60_000)?;
        let reconnect = &self.reconnect;
        within("[reconnect] silent_after_ms", reconnect.silent_after_ms, 100, 3_600_000)?;
        within("[reconnect] pause_ms", reconnect.pause_ms, 10, 3_600_000)?;
        within("[reconnect] longest_pause_ms", reconnect.longest_pause_ms, reconnect.pause_ms, 3_600_000)?;
        within("[report] every_s", self.report.every_s, 1, 86_400)?;
        if camera.driver == Driver::V4l {
            self.check_for_v4l()?;
        }
        Ok(())
    }

    /// What the kernel's interface does not have is refused, not passed over.
    fn check_for_v4l(&self) -> Result<(), ConfigError> {
        let camera = &self.camera;
        let only_genicam = |key, value: String| Err(refused(key, value, "with driver = \"genicam\" alone".to_owned()));
        if camera.trigger != "off" {
            return only_genicam("[camera] trigger", format!("{:?}", camera.trigger));
        }
        for (key, value) in [("[camera] offset_x_px", camera.offset_x_px), ("[camera] offset_y_px", camera.offset_y_px)]
        {
            if let Some(value) = value {
                return only_genicam(key, value.to_string());
            }
        }
        Ok(())
    }

    /// The shared memory of the cell; `max_frame_bytes` follows from the camera.
    pub fn service(&self) -> FrameServiceConfig {
        FrameServiceConfig {
            cell: self.cell.name.clone(),
            root_path: self.cell.root_path.clone(),
            buffer_frames: self.cell.buffer_frames,
            max_subscribers: self.cell.max_subscribers,
            ..FrameServiceConfig::default()
        }
    }
}

impl CameraSection {
    /// Whether this client starts each frame.
    pub(crate) fn triggers_itself(&self) -> bool {
        self.trigger == "Software"
    }

    /// Whether something starts each frame, so that silence says nothing.
    pub(crate) fn is_triggered(&self) -> bool {
        self.trigger != "off"
    }
}

/// A value that is not taken.
pub(crate) fn refused(key: &'static str, value: impl fmt::Display, allowed: String) -> ConfigError {
    ConfigError::Value { key, value: value.to_string(), allowed }
}

/// That a value lies in a range, ends included; NaN lies in none.
pub(crate) fn within<T: PartialOrd + fmt::Display>(
    key: &'static str,
    value: T,
    min: T,
    max: T,
) -> Result<(), ConfigError> {
    if value >= min && value <= max { Ok(()) } else { Err(refused(key, value, format!("{min} to {max}"))) }
}

fn optional<T: PartialOrd + fmt::Display>(
    key: &'static str,
    value: Option<T>,
    min: T,
    max: T,
) -> Result<(), ConfigError> {
    value.map_or(Ok(()), |value| within(key, value, min, max))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(text: &str) -> String {
        ClientConfig::parse(text, Path::new("camera-client.toml")).expect_err(text).to_string()
    }

    #[test]
    fn every_refusal_names_key_value_and_what_is_allowed() {
        for (text, expected) in [
            ("[camera]\nexposure_us = 0.0", "[camera] exposure_us = 0; allowed: 0.1 to 60000000"),
            ("[camera]\nexposure_us = nan", "[camera] exposure_us = NaN; allowed: 0.1 to 60000000"),
            ("[camera]\nwidth_px = 0", "[camera] width_px = 0; allowed: 1 to 16384"),
            ("[camera]\nheight_px = 16385", "[camera] height_px = 16385; allowed: 1 to 16384"),
            ("[camera]\nframe_rate_hz = -1.0", "[camera] frame_rate_hz = -1; allowed: 0.001 to 10000"),
            ("[camera]\ngain = inf", "[camera] gain = inf; allowed: -100 to 100000"),
            ("[camera]\nbuffers = 1", "[camera] buffers = 1; allowed: 2 to 64"),
            ("[camera]\ntrigger = \"\"", "[camera] trigger = \"\"; allowed: \"off\" or a trigger source of the camera"),
            (
                "[camera]\ntrigger = \"Software\"",
                "[camera] trigger_rate_hz = not given; allowed: 0.001 to 1000 with trigger = \"Software\"",
            ),
            (
                "[camera]\ntrigger_rate_hz = 5.0",
                "[camera] trigger_rate_hz = 5; allowed: with trigger = \"Software\" alone; it is \"off\"",
            ),
            (
                "[camera]\ndriver = \"v4l\"\ntrigger = \"Line1\"",
                "[camera] trigger = \"Line1\"; allowed: with driver = \"genicam\" alone",
            ),
            (
                "[camera]\ndriver = \"v4l\"\noffset_y_px = 3",
                "[camera] offset_y_px = 3; allowed: with driver = \"genicam\" alone",
            ),
            ("[gige]\npacket_size = 200", "[gige] packet_size = 200; allowed: 220 to 16384"),
            ("[gige]\nframe_retention_ms = 0", "[gige] frame_retention_ms = 0; allowed: 1 to 60000"),
            ("[reconnect]\npause_ms = 500\nlongest_pause_ms = 400", "longest_pause_ms = 400; allowed: 500 to 3600000"),
            ("[reconnect]\nsilent_after_ms = 99", "[reconnect] silent_after_ms = 99; allowed: 100 to 3600000"),
            ("[report]\nevery_s = 0", "[report] every_s = 0; allowed: 1 to 86400"),
            ("[cell]\nname = \"a b\"", "[cell]: cell name \"a b\" must be"),
            ("[cell]\nbuffer_frames = 0", "[cell]: buffer_frames is 0; 1 to 64 are allowed"),
            ("[camera]\nname = \"a name that has more than 31 bytes\"", "[camera] name: camera id \"a name"),
        ] {
            let message = refusal(text);
            assert!(message.contains(expected), "{text}: {message}");
        }
    }

    #[test]
    fn what_is_not_known_is_named() {
        for (text, expected) in [
            ("[camera]\npixel_format = \"yuv\"", ["unknown variant `yuv`", "`bayer_gb8`"]),
            ("[camera]\ndriver = \"usb\"", ["unknown variant `usb`", "`genicam` or `v4l`"]),
            ("[camera]\nexposure_us = \"long\"", ["\"long\" is not allowed", "or \"auto\""]),
            ("[gige]\npacket_size = 1.5", ["the value must be a number of the right kind", "packet_size"]),
            ("[camera]\nshutter_us = 5.0", ["unknown field `shutter_us`", "`exposure_us`"]),
            ("[light]\non = true", ["unknown field `light`", "`camera`"]),
        ] {
            let message = refusal(text);
            assert!(expected.iter().all(|part| message.contains(part)), "{text}: {message}");
        }
        let missing = ClientConfig::read(Path::new("/no/such/camera-client.toml")).unwrap_err();
        assert!(missing.to_string().starts_with("cannot read /no/such/camera-client.toml: "), "{missing}");
    }

    #[test]
    fn what_is_printed_is_a_configuration() {
        let text = "[camera]\npixel_format = \"bayer_rg8\"\nexposure_us = \"auto\"\ngain = 3.5\ntrigger = \"Line1\"\n\
                    [gige]\npacket_size = 9000\n[cell]\nroot_path = \"/run/samsod\"\n";
        let path = Path::new("camera-client.toml");
        let config = ClientConfig::parse(text, path).unwrap();
        assert_eq!(config.camera.pixel_format, Some(PixelFormat::BayerRg8));
        assert_eq!((config.camera.exposure_us, config.camera.gain), (Some(AutoOr::Auto), Some(AutoOr::Value(3.5))));
        assert_eq!(config.gige.packet_size, AutoOr::Value(9000));
        assert_eq!(ClientConfig::parse(&toml::to_string(&config).unwrap(), path).unwrap(), config);
    }

    #[test]
    fn the_example_is_a_configuration() {
        let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/camera-client.toml"));
        assert_eq!(ClientConfig::read(path).unwrap().camera.name, "top");
    }
}
