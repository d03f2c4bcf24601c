//! Every command of `docs/calibration.md` and of the book's first flight, run as it stands there by the real binary.

use std::path::Path;
use std::process::Command;
use std::sync::LazyLock;

use nalgebra::{Rotation3, Vector2, Vector3};
use windhover_base::geo::{CameraModel, LensModel, ned_from_body_321};
use windhover_base::msg::TagFamily;
use windhover_detect::{TagPattern, tag_pattern};

const DOC: &str = include_str!("../../docs/calibration.md");

#[test]
fn every_command_of_the_page_works() {
    let dir = tempfile::tempdir().expect("a scratch directory");
    photographs(&dir.path().join("photos"), chessboard);
    photographs(&dir.path().join("tags"), tags);
    std::fs::write(dir.path().join("windhover.toml"), include_str!("../../config/windhover.toml"))
        .expect("writable");
    let commands = commands_of(DOC);
    assert!(commands.len() >= 12, "{commands:?}");
    run(&commands, dir.path());
    for file in [
        "board.svg",
        "tags.svg",
        "plots/coverage.svg",
        "plots/residuals.svg",
        "predicted.svg",
        "compared.svg",
    ] {
        let text = std::fs::read_to_string(dir.path().join(file)).expect(file);
        assert!(text.contains("<svg") && !text.contains("NaN"), "{file}");
    }
    let page = std::fs::read_to_string(dir.path().join("report.html")).expect("the report");
    for section in ["Summary", "Errors", "Map", "States", "Measurements", "Sensors", "Camera", "Frames"] {
        assert!(page.contains(&format!("<h2>{section}</h2>")), "{section}");
    }
    assert!(page.len() < 3_000_000, "{}", page.len());
}

#[test]
fn every_command_of_the_first_flight_works() {
    let dir = tempfile::tempdir().expect("a scratch directory");
    let commands = commands_of(include_str!("../../docs/book/first-flight.md"));
    assert!(commands.len() >= 6, "{commands:?}");
    let messages = run(&commands, dir.path());
    assert!(messages.contains("event=model_misfit"), "{messages}");
    let page = std::fs::read_to_string(dir.path().join("report.html")).expect("the report");
    assert!(page.contains("<h2>Errors</h2>"), "the estimates are compared with the truth");
}

/// Runs commands in a directory; returns what they wrote to standard error.
fn run(commands: &[&str], dir: &Path) -> String {
    let mut messages = String::new();
    for command in commands {
        // The page is ours and its readers use a shell: it expands photos/*.png.
        let bin = env!("CARGO_BIN_EXE_windhover");
        let line = command.replacen("windhover", &format!("'{bin}'"), 1);
        let run = Command::new("sh").arg("-c").arg(&line).current_dir(dir).output().expect("a shell");
        let text = String::from_utf8_lossy(&run.stderr);
        assert!(run.status.success(), "{command}\n{text}");
        messages.push_str(&text);
    }
    messages
}

/// The lines of the page's `sh` blocks.
fn commands_of(page: &str) -> Vec<&str> {
    let mut inside = false;
    let mut commands = Vec::new();
    for line in page.lines() {
        match line {
            "```sh" => inside = true,
            "```" => inside = false,
            _ if inside => commands.push(line),
            _ => {}
        }
    }
    commands
}

/// Whether a target is dark at a point of its sheet, metres; `None` beside the sheet.
type Sheet = fn(Vector2<f64>) -> Option<bool>;

/// A board of 9 x 6 inner corners, 25 mm apart, the first at the origin.
fn chessboard(at: Vector2<f64>) -> Option<bool> {
    let (c, r) = (at.x / 0.025 + 1.0, at.y / 0.025 + 1.0);
    if !(-0.6..10.6).contains(&c) || !(-0.6..7.6).contains(&r) {
        return None;
    }
    let inside = (0.0..10.0).contains(&c) && (0.0..7.0).contains(&r);
    Some(inside && (c.floor() + r.floor()) as i64 % 2 == 0)
}

static PATTERNS: LazyLock<Vec<TagPattern>> =
    LazyLock::new(|| (0..24).map(|id| tag_pattern(TagFamily::Tag36h11, id)).collect());

/// 6 x 4 tags of 30 mm, 10 mm between them, the first one's corner at the origin.
fn tags(at: Vector2<f64>) -> Option<bool> {
    let (c, r) = ((at.x / 0.04).floor(), (at.y / 0.04).floor());
    if !(-1.0..7.0).contains(&c) || !(-1.0..5.0).contains(&r) {
        return None;
    }
    if !(0.0..6.0).contains(&c) || !(0.0..4.0).contains(&r) {
        return Some(false);
    }
    let pattern = &PATTERNS[(r * 6.0 + c) as usize];
    let cell = (at - Vector2::new(c, r) * 0.04) * (pattern.border as f64 / 0.03);
    let side = pattern.border as f64;
    let on_border = cell.x < side && cell.y < side;
    Some(on_border && !pattern.white(cell.x as usize + 1, cell.y as usize + 1))
}

/// Photographs of a sheet, tilted each way.
fn photographs(dir: &Path, sheet: Sheet) {
    std::fs::create_dir(dir).expect("writable");
    let camera = CameraModel {
        fx: 620.0,
        fy: 618.0,
        cx: 322.0,
        cy: 241.0,
        model: LensModel::Brown,
        distortion: [-0.15, 0.03, 0.0, 0.0, 0.0],
        skew: 0.0,
    };
    let tilts = [(0.5, 0.0), (-0.5, 0.1), (0.1, 0.5), (0.0, -0.5), (0.4, 0.4), (-0.4, -0.4)];
    for (k, (pitch, roll)) in tilts.into_iter().enumerate() {
        let rotation = ned_from_body_321(0.0, pitch, roll);
        let middle = Vector3::new(0.1, 0.0625, 0.0);
        let translation = Vector3::new(0.0, 0.0, 0.42) - rotation * middle;
        let mut image = image::GrayImage::new(640, 480);
        for (u, v, pixel) in image.enumerate_pixels_mut() {
            let light: f64 = (0..9)
                .map(|s| {
                    let at = Vector2::new(
                        f64::from(u) + f64::from(s % 3) * 0.6 - 0.6,
                        f64::from(v) + f64::from(s / 3) * 0.6 - 0.6,
                    );
                    brightness(&camera, &rotation, &translation, at, sheet)
                })
                .sum();
            pixel.0 = [(light / 9.0) as u8];
        }
        image.save(dir.join(format!("board{k}.png"))).expect("writable");
    }
}

fn brightness(
    camera: &CameraModel,
    rotation: &Rotation3<f64>,
    translation: &Vector3<f64>,
    px: Vector2<f64>,
    sheet: Sheet,
) -> f64 {
    let Some(m) = camera.normalised(px) else { return 110.0 };
    let ray = rotation.inverse() * Vector3::new(m.x, m.y, 1.0);
    let origin = rotation.inverse() * -translation;
    let at = origin - ray * (origin.z / ray.z);
    match sheet(at.xy()) {
        Some(true) => 30.0,
        Some(false) => 220.0,
        None => 110.0,
    }
}
