//! The record of every byte between a controller and this program.

/// Where the bytes of a connection are written down.
///
/// [`sending`](Self::sending) is called before the bytes leave: when it fails, they must not.
pub trait WireLog: Send {
    /// These bytes are about to be sent. Returns when they are recorded.
    ///
    /// # Errors
    /// Why they could not be recorded; they are then not sent.
    fn sending(&mut self, bytes: &[u8]) -> Result<(), String>;

    /// These bytes are to make the robot stand, and are about to be sent whether or not they can be recorded: a full or slow
    /// disk must not keep a robot moving.
    fn sending_hold(&mut self, bytes: &[u8]) {
        let _ = self.sending(bytes);
    }

    /// These bytes have come. Never waits.
    fn received(&mut self, bytes: &[u8]);
}

/// Writes nothing down: for programs that keep no recording.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoWireLog;

impl WireLog for NoWireLog {
    fn sending(&mut self, _bytes: &[u8]) -> Result<(), String> {
        Ok(())
    }

    fn received(&mut self, _bytes: &[u8]) {}
}

/// Lets bytes leave that could not be recorded.
pub(crate) struct Unconditional<'a>(pub(crate) &'a mut dyn WireLog);

impl WireLog for Unconditional<'_> {
    fn sending(&mut self, bytes: &[u8]) -> Result<(), String> {
        self.0.sending_hold(bytes);
        Ok(())
    }

    fn received(&mut self, bytes: &[u8]) {
        self.0.received(bytes);
    }
}
