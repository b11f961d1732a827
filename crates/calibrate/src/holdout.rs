//! What is held out: the recordings that judge a fit.

/// Share of each recording that is held out where no recording is ([`Data::split_tail`](crate::Data::split_tail)).
pub const HELD_OUT_SHARE: f64 = 0.2;

/// Where the held-out recordings come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HoldoutSource {
    /// Recordings of their own.
    Given,
    /// The last fifth of each training recording.
    LastFifth,
    /// The last block of recordings that were read in blocks.
    LastBlock,
    /// None: the recordings are too short to cut.
    None,
}
