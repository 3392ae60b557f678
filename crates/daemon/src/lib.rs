//! The service and the command line of samsod.
//!
//! [`config`] reads what `samsodd` is told; [`service`] runs it: frames in from shared memory, scenes out, every stage
//! to the recording, commands to the robot. [`publish`] is the frame client of the command line, [`inspect`] its look
//! at one image; [`recording`] writes and reads recordings, [`picture`] draws.

pub mod config;
pub mod inspect;
pub mod picture;
pub mod publish;
pub mod recording;
pub mod service;

mod cell_lock;
mod commander;
mod durations;
mod pick;
