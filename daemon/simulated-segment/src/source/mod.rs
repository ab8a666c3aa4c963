//! Sources of encoder signals: a built-in motion of the joints, or a recording. For each conversion, a terminal requests the
//! signal at its input.

mod hand_turned;
mod reference_mark;
mod replay;
mod smooth;

pub use hand_turned::{Hand, HandTurned};
pub use replay::{Replay, ReplayError, ReplayHandle};
pub use smooth::SmoothMotion;

/// Time of a conversion, at which a terminal samples its input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conversion {
    /// True time of the simulation \[ns\].
    pub true_time_ns: i64,
    /// Nominal time of the SYNC0 pulse in the system time of the bus \[ns\]. `None` if frames start
    /// the conversions of the terminal.
    pub system_time_ns: Option<i64>,
}

/// A number of signal periods in fixed point with 32 fraction bits. It wraps after 2^31 periods.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Periods(pub i64);

impl Periods {
    /// One signal period in this fixed point.
    pub const ONE: i64 = 1 << 32;

    /// Rounds to the nearest fixed point number.
    pub fn from_f64(periods: f64) -> Self {
        Self((periods * Self::ONE as f64).round() as i64)
    }
}

/// Signal at the input of a terminal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Signal {
    /// Signal of a turning encoder.
    Turning {
        /// Angle of the encoder in signal periods.
        position: Periods,
        /// Speed, with its sign \[signal periods per second\].
        periods_per_s: f64,
        /// Signal amplitude as a fraction of 1 Vpp.
        amplitude: f64,
        /// Position of the reference mark, if it was passed since the last conversion.
        reference_mark: Option<Periods>,
        /// Whether the encoder is at the reference mark.
        on_reference_mark: bool,
    },
    /// A recorded counter value. The terminal outputs this value unchanged, whatever its settings are.
    Recorded {
        /// Counter value of the terminal.
        count: u32,
    },
}

impl Signal {
    /// Signal of an input without encoder.
    pub const NOT_CONNECTED: Self = Self::Turning {
        position: Periods(0),
        periods_per_s: 0.0,
        amplitude: 0.0,
        reference_mark: None,
        on_reference_mark: false,
    };
}

/// Provides the encoder signals at the inputs of the terminals.
pub trait EncoderSource: Send {
    /// The signal of terminal `channel` at a conversion. Channels are counted from 0, beginning at the coupler. For each
    /// channel, times must be ascending.
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal;
}
