//! Sources of encoder signals: a built-in motion, or a recording.

mod hand_turned;
mod reference_mark;
mod replay;
mod smooth;

pub use hand_turned::{Hand, HandTurned};
pub use replay::{Replay, ReplayError, ReplayHandle};
pub use smooth::SmoothMotion;

/// The time at which a terminal samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conversion {
    /// The simulation's absolute time.
    pub true_time_ns: i64,
    /// Nominal time of the SYNC0 pulse on the system time of the bus; `None` if the terminal follows frames.
    pub system_time_ns: Option<i64>,
}

/// Number of signal periods as fixed point with 32 fraction bits; wraps after 2^31 periods.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Periods(pub i64);

impl Periods {
    /// One signal period as fixed point number.
    pub const ONE: i64 = 1 << 32;

    /// Nearest fixed point number.
    pub fn from_f64(periods: f64) -> Self {
        Self((periods * Self::ONE as f64).round() as i64)
    }
}

/// Signal at a terminal's inputs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Signal {
    /// Signal of a turning encoder.
    Turning {
        /// Angle of the encoder in signal periods.
        position: Periods,
        /// Speed, signal periods per second.
        periods_per_s: f64,
        /// Signal amplitude as a fraction of 1 Vpp.
        amplitude: f64,
        /// Position of the reference mark, if it was passed since the last conversion.
        reference_mark: Option<Periods>,
        /// Whether the encoder is at the reference mark.
        on_reference_mark: bool,
    },
    /// A recorded counter value, which the terminal passes on unchanged, independent of its settings.
    Recorded {
        /// Counter value of the terminal.
        count: u32,
    },
}

impl Signal {
    /// The terminal is not connected.
    pub const NOT_CONNECTED: Self = Self::Turning {
        position: Periods(0),
        periods_per_s: 0.0,
        amplitude: 0.0,
        reference_mark: None,
        on_reference_mark: false,
    };
}

/// Provides the encoder signals for the terminals.
pub trait EncoderSource: Send {
    /// Signal at a conversion on terminal `channel`, counted from the coupler, from 0. Conversions of a channel are in
    /// ascending order of time.
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal;
}
