//! Which channels of recordings are read, and what they are called: arguments that subcommands share.

use clap::Args;
use greybox_model::Unit;
use greybox_recording::{Rename, RenameError};

use crate::loading::Wanted;

/// What the model calls the channels.
#[derive(Debug, Args)]
pub(crate) struct Names {
    // (Not a doc comment: rustdoc takes a unit in brackets for a link.)
    #[arg(
        long,
        value_name = "NAME=CHANNEL",
        value_parser = rename,
        help = "Name of the model for a channel of the recordings, with its unit where they state none, such as \
                \"theta=sensor_3 [deg]\"; may be repeated"
    )]
    pub(crate) map: Vec<Rename>,
}

/// The channels of the recordings: which are read, and what the model calls them.
#[derive(Debug, Args)]
pub(crate) struct Channels {
    #[command(flatten)]
    pub(crate) names: Names,

    #[arg(
        id = "channels",
        long = "channels",
        value_name = "CHANNEL",
        help = "Channel to read, such as \"/joint_states.position[elbow]\", and no other but those of --map; may be repeated \
                [default: what model and --map name, of a file with several clocks]"
    )]
    pub(crate) only: Vec<String>,
}

impl Channels {
    /// What is read of the recordings.
    pub(crate) fn wanted(&self) -> Wanted {
        Wanted::new(&self.names.map, &self.only)
    }
}

/// A [`Rename`] whose unit, if it has one, is written as one; a symbol that is not built in may be declared by the model.
fn rename(text: &str) -> Result<Rename, String> {
    let rename: Rename = text.parse().map_err(|e: RenameError| e.to_string())?;
    match rename.unit.as_deref().map(Unit::parse) {
        Some(Err(error)) if error.unknown.is_none() && rename.states_unit() => Err(error.to_string()),
        _ => Ok(rename),
    }
}
