//! Reading configuration files.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::config::{Config, ConfigError};
use crate::io::{self, terrain::TileError};
use windhover_base::geo::Tile;

/// Why a configuration could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ConfigFileError {
    /// The file could not be read.
    #[error("cannot read configuration {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file does not hold a valid configuration.
    #[error("configuration {}: {source}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: ConfigError,
    },
    /// The terrain tile that it names could not be read.
    #[error("configuration {}: ground.terrain: {source}", path.display())]
    Terrain {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TileError,
    },
}

/// A configuration, and the terrain that it names.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The configuration.
    pub config: Config,
    /// Its terrain tile, where it names one.
    pub terrain: Option<Arc<Tile>>,
}

/// Reads and checks a configuration file.
pub fn load(path: &Path) -> Result<Config, ConfigFileError> {
    load_all(path).map(|loaded| loaded.config)
}

/// Reads and checks a configuration file and the terrain tile that it names. Blocks: reading a tile takes seconds.
pub fn load_all(path: &Path) -> Result<Loaded, ConfigFileError> {
    let text =
        read_text(path).map_err(|source| ConfigFileError::Unreadable { path: path.to_owned(), source })?;
    let config =
        Config::parse(&text).map_err(|source| ConfigFileError::Invalid { path: path.to_owned(), source })?;
    let terrain = config.ground.terrain.as_ref().map(|terrain| {
        io::terrain::load(Path::new(terrain))
            .map_err(|source| ConfigFileError::Terrain { path: path.to_owned(), source })
    });
    let terrain = terrain.transpose()?.map(Arc::new);
    Ok(Loaded { config, terrain })
}

/// Largest size of a configuration, bytes.
const LONGEST: u64 = 1 << 20;

/// The text of a file. The file may be a device that never ends.
fn read_text(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    let read = File::open(path)?.take(LONGEST + 1).read_to_string(&mut text)?;
    if read as u64 > LONGEST {
        return Err(std::io::Error::other("it is longer than 1 MB, the limit for a configuration"));
    }
    Ok(text)
}

/// The terrain tile of a recording's configuration: the file of that name beside the recording, else the file that the
/// configuration names. `None` where it names none or the file cannot be read: a recording may name a tile of another
/// machine, and the pipeline then reports it.
pub fn terrain_of(config: &Config, recording: &Path) -> Option<Arc<Tile>> {
    let named = Path::new(config.ground.terrain.as_ref()?);
    let beside = named.file_name().map(|name| recording.with_file_name(name));
    let files = beside.into_iter().chain([named.to_owned()]);
    files.filter_map(|file| io::terrain::load(&file).ok()).map(Arc::new).next()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_never_ends_is_no_configuration() {
        let error = load(Path::new("/dev/zero")).expect_err("it never ends").to_string();
        assert!(error.contains("/dev/zero") && error.contains("longer than 1 MB"), "{error}");
    }
}
