//! Terrain tiles from files: SRTM `.hgt` and GeoTIFF.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

use super::regular;
use windhover_base::geo::{TerrainError, Tile};

/// GDAL's tag for the value of missing heights, as text (GDAL, GeoTIFF driver).
const GDAL_NODATA: Tag = Tag::Unknown(42_113);
/// Heights beyond this mark missing values, metres.
const HIGHEST_M: f64 = 12_000.0;

/// Bytes of the largest `.hgt` file, 3601 heights square.
const LARGEST_HGT: u64 = 3601 * 3601 * 2;
/// Bytes of the largest accepted GeoTIFF: 1″ floats over two degrees square, uncompressed.
const LARGEST_TIFF: u64 = 1 << 28;

/// Why a file could not be used as a tile.
#[derive(Debug, thiserror::Error)]
pub enum TileError {
    /// The file could not be read.
    #[error("cannot read terrain {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Not a TIFF file, or of a kind that is not supported.
    #[error("terrain {}: {source}", path.display())]
    Tiff {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: tiff::TiffError,
    },
    /// The heights are not a grid in latitude and longitude.
    #[error("terrain {}: {source}", path.display())]
    Tile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TerrainError,
    },
    /// A GeoTIFF without its position, or with other values than heights.
    #[error("terrain {}: {reason}", path.display())]
    Unfit {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do.
        reason: &'static str,
    },
}

/// Reads a tile: `.hgt` as SRTM, anything else as GeoTIFF in degrees of latitude and longitude.
pub fn load(path: &Path) -> Result<Tile, TileError> {
    let is_hgt = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("hgt"));
    if !is_hgt {
        return geotiff(path);
    }
    let bytes =
        regular::read(path, LARGEST_HGT).map_err(|source| TileError::Io { path: path.to_owned(), source })?;
    let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    Tile::from_hgt(&stem, &bytes).map_err(|source| TileError::Tile { path: path.to_owned(), source })
}

fn geotiff(path: &Path) -> Result<Tile, TileError> {
    let io = |source| TileError::Io { path: path.to_owned(), source };
    let file = regular::open(path).map_err(io)?;
    if file.metadata().map_err(io)?.len() > LARGEST_TIFF {
        return Err(io(std::io::Error::other(
            "it is longer than 256 MB; cut out the area with gdalwarp -te",
        )));
    }
    let wrong = |source| TileError::Tiff { path: path.to_owned(), source };
    let unfit = |reason| TileError::Unfit { path: path.to_owned(), reason };
    let mut decoder = Decoder::new(BufReader::new(file)).map_err(wrong)?.with_limits(Limits::default());
    let (columns, rows) = decoder.dimensions().map_err(wrong)?;
    let mut numbers = |tag: Tag| decoder.find_tag(tag).ok().flatten().and_then(|v| v.into_f64_vec().ok());
    let (scale, tie) = (numbers(Tag::ModelPixelScaleTag), numbers(Tag::ModelTiepointTag));
    let keys = numbers(Tag::GeoKeyDirectoryTag).unwrap_or_default();
    let (Some(scale), Some(tie)) = (scale, tie) else {
        return Err(unfit("its position is missing (ModelPixelScale and ModelTiepoint)"));
    };
    let ([dx, dy, ..], [i, j, _, x, y, ..]) = (&scale[..], &tie[..]) else {
        return Err(unfit("its position is missing (ModelPixelScale and ModelTiepoint)"));
    };
    let key = |id: f64| keys.chunks_exact(4).skip(1).find(|k| k[0] == id).map(|k| k[3]);
    // GTModelType 2 is geographic; with GTRasterType 2 the tie point is on a height, with 1 on a pixel's corner.
    if key(1024.0).is_some_and(|model| model != 2.0) {
        return Err(unfit("it is not in latitude and longitude: convert it with gdalwarp -t_srs EPSG:4326"));
    }
    let half = if key(1025.0) == Some(2.0) { 0.0 } else { 0.5 };
    let missing =
        decoder.get_tag_ascii_string(GDAL_NODATA).ok().and_then(|t| t.trim_matches('\0').trim().parse().ok());
    let heights = heights(decoder.read_image().map_err(wrong)?, missing)
        .ok_or_else(|| unfit("its values are not heights: 16-bit integers, 32-bit integers or floats"))?;
    let (north, west) = (y - (half - j) * dy, x + (half - i) * dx);
    Tile::new((north, west), [*dy, *dx], (rows as usize, columns as usize), heights)
        .map_err(|source| TileError::Tile { path: path.to_owned(), source })
}

fn heights(image: DecodingResult, missing: Option<f64>) -> Option<Vec<f32>> {
    let height = |h: f64| {
        let void = missing == Some(h) || !(h.abs() < HIGHEST_M);
        if void { f32::NAN } else { h as f32 }
    };
    Some(match image {
        DecodingResult::I16(v) => v.into_iter().map(|h| height(f64::from(h))).collect(),
        DecodingResult::U16(v) => v.into_iter().map(|h| height(f64::from(h))).collect(),
        DecodingResult::I32(v) => v.into_iter().map(|h| height(f64::from(h))).collect(),
        DecodingResult::F32(v) => v.into_iter().map(|h| height(f64::from(h))).collect(),
        DecodingResult::F64(v) => v.into_iter().map(height).collect(),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    #[test]
    fn a_geotiff_lies_where_its_tags_say() {
        use tiff::encoder::{TiffEncoder, colortype};
        let dir = tempfile::tempdir().expect("a scratch directory");
        let path = dir.path().join("hill.tif");
        let heights: Vec<f32> = (0..20).map(|k| if k == 7 { -9999.0 } else { k as f32 }).collect();
        let file = File::create(&path).expect("writable");
        let mut encoder = TiffEncoder::new(file).expect("a header");
        let mut image = encoder.new_image::<colortype::Gray32Float>(5, 4).expect("an image");
        let tags = image.encoder();
        tags.write_tag(Tag::ModelPixelScaleTag, &[0.1f64, 0.1, 0.0][..]).expect("a tag");
        tags.write_tag(Tag::ModelTiepointTag, &[0.0f64, 0.0, 0.0, -86.0, 31.0, 0.0][..]).expect("a tag");
        tags.write_tag(GDAL_NODATA, "-9999").expect("a tag");
        image.write_data(&heights).expect("heights");
        let tile = load(&path).expect("a tile");
        // The corner is at (31, −86): the first height is half a pixel inside.
        assert_eq!(tile.height_msl_m(30.95, -85.95), 0.0);
        assert!((tile.height_msl_m(30.65, -85.55) - 19.0).abs() < 1e-4);
        // The missing height is filled from its neighbours.
        assert!((tile.height_msl_m(30.85, -85.75) - 7.0).abs() < 1e-4);
    }

    #[test]
    fn what_is_no_terrain_says_so() {
        let error = load(Path::new("/nonexistent/N30W086.hgt")).expect_err("there is none");
        assert!(error.to_string().contains("N30W086.hgt"), "{error}");
    }
}
