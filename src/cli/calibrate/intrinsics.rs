//! `windhover calibrate intrinsics`

use std::path::{Path, PathBuf};

use nalgebra::Vector2;
use serde_json::json;

use super::target::{Board, Target, TargetArgs, positive};
use crate::cli::out::{note, outln};
use crate::cli::{CliError, CliResult, place};
use crate::io::new_file::Inputs;
use crate::pixels;
use crate::plot;
use crate::plot::intrinsics::{coverage_advice, coverage_svg, per_view_svg, residuals_svg};
use windhover_base::geo::{CameraModel, LensModel};
use windhover_base::msg::GrayImage;
use windhover_calibrate::intrinsics::{Intrinsics, Wanted, calibrate, parameters};
use windhover_calibrate::{PlaneView, WINDOW_PX, find_corners};

/// Calibrate the lens from photographs of a printed chessboard or grid of tags.
///
/// Corners are found automatically, in every orientation of the board. Photographs that cannot be used are listed with
/// the reason. Uncertainties are one sigma (MATLAB's toolbox prints three). The output ends with the block for the
/// configuration. Take 15 to 30 photographs, the board tilted by 20 to 45 degrees in different directions and near
/// every edge of the image.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover calibrate intrinsics photos/*.png --board 9x6 --square-m 0.025 --plots plots
  windhover calibrate intrinsics photos/*.png --board 6x4 --tag-m 0.035 --gap-m 0.01
  windhover calibrate intrinsics photos/*.png --board 9x6 --square-m 0.03 --tag-m 0.022 --family aruco_4x4_50
  windhover calibrate intrinsics photos/*.png --board 9x6 --square-m 0.025 --json")]
pub(super) struct Args {
    /// Photographs of the board, all of the same size, taken with the same focus
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    #[command(flatten)]
    target: TargetArgs,
    /// Half the window in which a chessboard's corner is located, pixels; only the part that is nearer to the corner's
    /// own edges than to the next ones is used. The default is that of OpenCV's calibration
    #[arg(long, value_name = "PX", value_parser = positive, default_value_t = WINDOW_PX)]
    window: f64,
    /// How the lens departs from a pinhole: `brown`, or `fisheye` (Kannala and Brandt, as OpenCV's fisheye) for lenses
    /// that bend straight lines much
    #[arg(long, value_name = "MODEL", value_parser = lens_model, default_value = "brown")]
    model: LensModel,
    /// Keep the third radial term of brown at zero
    #[arg(long)]
    no_k3: bool,
    /// Also estimate the skew of the pixel axes
    #[arg(long)]
    skew: bool,
    /// Draw residuals, error per image and coverage into this directory
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// One JSON object on standard output
    #[arg(long)]
    json: bool,
}

fn lens_model(text: &str) -> Result<LensModel, String> {
    match text {
        "brown" => Ok(LensModel::Brown),
        "fisheye" => Ok(LensModel::Fisheye),
        _ => Err("brown or fisheye".to_owned()),
    }
}

/// The drawings.
const PLOTS: [&str; 3] = ["residuals.svg", "per_image.svg", "coverage.svg"];

/// A photograph and its detections.
struct Photo {
    name: String,
    found: Result<PlaneView, String>,
}

pub(super) fn run(args: &Args) -> CliResult {
    if let Some(dir) = &args.plots {
        let inputs = Inputs::of(args.images.iter().map(PathBuf::as_path));
        PLOTS.iter().try_for_each(|file| place::check(&dir.join(file), &inputs, &place::DRAWING))?;
    }
    let (photos, size) = look_at(args)?;
    for photo in &photos {
        if let Err(reason) = &photo.found {
            note!("windhover: not used: {}: {reason}", photo.name);
        }
    }
    let used: Vec<&Photo> = photos.iter().filter(|p| p.found.is_ok()).collect();
    let views: Vec<PlaneView> = photos.iter().filter_map(|p| p.found.clone().ok()).collect();
    let (width, height) = (size.0 as f64, size.1 as f64);
    let wanted = Wanted { model: args.model, k3: !args.no_k3, skew: args.skew };
    let result = calibrate(&views, width, height, wanted).map_err(CliError::failed)?;
    let names: Vec<&str> = used.iter().map(|p| p.name.as_str()).collect();
    if let Some(dir) = &args.plots {
        draw(dir, &result, &views, &names, size)?;
    }
    if args.json {
        outln!("{}", as_json(&result, &photos))?;
    } else {
        print_text(&result, &names, &views, size)?;
    }
    Ok(())
}

fn look_at(args: &Args) -> Result<(Vec<Photo>, (usize, usize)), CliError> {
    let target = args.target.target()?;
    let mut size = None;
    let mut photos = Vec::with_capacity(args.images.len());
    for path in &args.images {
        let name = path.display().to_string();
        let image = match read(path) {
            Ok(image) => image,
            Err(reason) => {
                photos.push(Photo { name, found: Err(reason) });
                continue;
            }
        };
        let first = *size.get_or_insert((image.width, image.height));
        let found = if first == (image.width, image.height) {
            corners_of(&image, target, args.window)
        } else {
            Err(format!(
                "is {}x{} pixels; the first image is {}x{}",
                image.width, image.height, first.0, first.1
            ))
        };
        photos.push(Photo { name, found });
    }
    match size {
        Some(size) => Ok((photos, size)),
        None => {
            let reasons: Vec<String> = photos
                .iter()
                .take(3)
                .filter_map(|p| Some(format!("{}: {}", p.name, p.found.as_ref().err()?)))
                .collect();
            Err(CliError::failed(format!("no image could be read: {}", reasons.join("; "))))
        }
    }
}

fn read(path: &Path) -> Result<GrayImage, String> {
    let bytes = std::fs::read(path).map_err(|e| format!("cannot be read: {e}"))?;
    match pixels::picture(&bytes) {
        Ok((image, missing)) if missing.is_empty() => Ok(image),
        Ok(_) => Err("is damaged: parts of it are missing".to_owned()),
        Err(reason) => Err(format!("cannot be read: {reason}")),
    }
}

fn corners_of(image: &GrayImage, target: Target, window_px: f64) -> Result<PlaneView, String> {
    let (Board { columns, rows }, square_m) = match target {
        Target::Chessboard { board, square_m } => (board, square_m),
        Target::Charuco(board) => return board.find(image.view(), window_px).map_err(|e| e.to_string()),
        Target::Tags(grid) => return grid.find(image.view()).map_err(|e| e.to_string()),
    };
    let corners = find_corners(image.view(), columns, rows, window_px).map_err(|e| e.to_string())?;
    let at = |k: usize| Vector2::new((k % columns) as f64, (k / columns) as f64) * square_m;
    let (plane_m, px) = corners.iter().enumerate().filter_map(|(k, c)| Some((at(k), (*c)?))).unzip();
    Ok(PlaneView { plane_m, px })
}

fn draw(
    dir: &Path,
    result: &Intrinsics,
    views: &[PlaneView],
    names: &[&str],
    size: (usize, usize),
) -> CliResult {
    std::fs::create_dir_all(dir)
        .map_err(|e| CliError::failed(format!("cannot write into {}: {e}", dir.display())))?;
    let drawn = [residuals_svg(result, views, size), per_view_svg(result, names), coverage_svg(views, size)];
    for (file, svg) in PLOTS.iter().zip(drawn) {
        place::write(&dir.join(file), &plot::standalone(&svg))?;
    }
    Ok(())
}

fn as_json(result: &Intrinsics, photos: &[Photo]) -> serde_json::Value {
    let c = &result.camera;
    let sigma: serde_json::Map<String, serde_json::Value> =
        fitted(result).map(|(name, _, sigma)| (name.to_owned(), json!(sigma))).collect();
    let used = photos.iter().filter(|p| p.found.is_ok()).zip(&result.views);
    let images: Vec<_> = used.map(|(p, fit)| json!({"image": p.name, "rms_px": fit.rms_px})).collect();
    let refused: Vec<_> = photos
        .iter()
        .filter_map(|p| p.found.as_ref().err().map(|reason| json!({"image": p.name, "reason": reason})))
        .collect();
    json!({
        "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "model": c.model,
        "distortion": terms(c),
        "skew": c.skew,
        "sigma": sigma,
        "rms_px": result.rms_px,
        "images_used": result.views.len(),
        "corners": result.points,
        "images": images,
        "refused": refused,
    })
}

/// Name, value and sigma of every parameter that the model has.
fn fitted(result: &Intrinsics) -> impl Iterator<Item = (&'static str, f64, f64)> {
    let c = result.camera;
    let values = [c.fx, c.fy, c.cx, c.cy].into_iter().chain(c.distortion).chain([c.skew]);
    let named = parameters(c.model).into_iter().zip(values.zip(result.sigma));
    named.filter(|(name, _)| !name.is_empty()).map(|(name, (value, sigma))| (name, value, sigma))
}

/// The distortion's terms that the model has.
fn terms(camera: &CameraModel) -> &[f64] {
    match camera.model {
        LensModel::Brown => &camera.distortion,
        LensModel::Fisheye => &camera.distortion[..4],
    }
}

fn print_text(result: &Intrinsics, names: &[&str], views: &[PlaneView], size: (usize, usize)) -> CliResult {
    let c = &result.camera;
    outln!(
        "{} images, {} corners, error {:.4} px (root mean square)\n",
        names.len(),
        result.points,
        result.rms_px
    )?;
    outln!("parameter        value   one sigma")?;
    for (name, value, sigma) in fitted(result) {
        if sigma > 0.0 {
            outln!("{name:<10} {value:>12.5} {sigma:>11.5}")?;
        } else {
            outln!("{name:<10} {value:>12.5}       fixed")?;
        }
    }
    outln!("\nerror per image, px")?;
    for (name, fit) in names.iter().zip(&result.views) {
        outln!("{:7.4}  {name}", fit.rms_px)?;
    }
    for advice in coverage_advice(result, views, size) {
        outln!("\n{advice}")?;
    }
    outln!("\n[camera.intrinsics]")?;
    if c.model == LensModel::Fisheye {
        outln!("model = \"fisheye\"")?;
    }
    outln!("fx = {:.5}\nfy = {:.5}\ncx = {:.5}\ncy = {:.5}", c.fx, c.fy, c.cx, c.cy)?;
    let terms: Vec<String> = terms(c).iter().map(|k| format!("{k:.6}")).collect();
    outln!("distortion = [{}]", terms.join(", "))?;
    if c.skew != 0.0 {
        outln!("skew = {:.7}", c.skew)?;
    }
    Ok(())
}
