//! The service and the command line of samsod.
//!
//! [`config`] reads what `samsodd` is told; [`service`] runs it: frames in from shared memory, scenes out, every stage
//! to the recording, commands to the robot. [`place`] takes objects from the image to the table and to the robot.
//! [`publish`] is the frame client of the command line, [`inspect`] its look at one image, [`calibrate`] its way to a
//! camera file, [`teach`] its way to a catalogue of parts, which [`catalogue`] lists; [`recording`] writes and reads
//! recordings, [`picture`] draws and [`caption`] writes on pictures, [`masks`] says which pixels are objects and which are
//! shadows. [`control`] is an operator's line to the robot. Where there is neither robot nor table, [`emulate`] stands in for
//! the controller and [`twin`] for table and camera. [`generate`] writes manual pages, shell completions and
//! [`config_schema`], the schema of the configuration. [`made_with`] says what a recording was made with, [`replay`] sees it
//! again, [`config_changes`] tells configurations apart, [`journal`] is systemd's.

pub mod calibrate;
pub mod caption;
pub mod catalogue;
pub mod config;
pub mod config_changes;
pub mod config_schema;
pub mod control;
pub mod daemon_arguments;
pub mod emulate;
pub mod generate;
pub mod inspect;
pub mod journal;
pub mod made_with;
pub mod masks;
pub mod picture;
pub mod place;
pub mod publish;
pub mod recording;
pub mod replay;
pub mod service;
pub mod teach;
pub mod twin;

mod cell_lock;
mod commander;
mod durations;
mod ending;
mod frame_clients;
mod health;
mod http;
mod interest;
mod kept_frame;
mod metrics;
mod page;
mod pick;
mod pulse;
mod report;
mod scene_sender;
mod sight;
mod supervisor;
mod wall_clock;
mod watched;
