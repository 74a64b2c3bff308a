//! `limpid export`.

use crate::checkpoints;
use crate::claim::claimed;
use crate::config::{Backend, Config};
use crate::failure::{Failure, refuse_idle};
use crate::moments::{Moments, within};
use crate::numbered::Numbered;
use crate::say::{conclude, say};
use io::{ExportedView, Gaussians, Glb, GlbPart, RigidMotion, SparsePoint, SpzLoss};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use trainer::{CameraView, Run};

/// Arguments of `limpid export`.
#[derive(Debug, clap::Args)]
pub(crate) struct ExportArguments {
    /// Folder with a run's results.
    run: PathBuf,
    /// What is written; several with commas between them.
    #[arg(long, value_name = "FORMAT", value_delimiter = ',', required = true)]
    format: Vec<Format>,
    /// Folder for it, new, empty or of an earlier time [default: RUN/export].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// The moment that ply, spz and glb hold, in training frames, may be fractional; may be given more than once
    /// [default: --from; for glb all moments, as an animation].
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    at: Vec<f32>,
    #[command(flatten)]
    moments: Moments,
    /// Leave out spherical harmonics over this degree: files of degree 0 are a quarter of the size, without view-dependent colour.
    #[arg(long, value_name = "DEGREE", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: Option<u8>,
    /// With glb: training frames in a second of its animation [default: 24].
    #[arg(long, value_name = "FPS", allow_negative_numbers = true)]
    fps: Option<f64>,
    /// With glb: how near pictures of movers in rigid parts have to come to their own, in dB [default: 35].
    #[arg(long, value_name = "DB", allow_negative_numbers = true)]
    fidelity: Option<f64>,
    /// With glb: rigid parts that movers are cut into at most [default: 256].
    #[arg(long, value_name = "N")]
    nodes: Option<usize>,
    /// Where tensors live [default: where they did in training].
    #[arg(long)]
    backend: Option<Backend>,
}

impl ExportArguments {
    /// Whether movers move in what is written.
    fn is_animated(&self) -> bool {
        self.format.contains(&Format::Glb) && self.at.is_empty()
    }

    /// An error for a flag that changes nothing of what is written.
    fn check(&self) -> Result<(), Failure> {
        use Format::{Canonical, Glb, Ply, PlySequence, Spz};
        if self.is_animated() && self.moments.are_given() {
            return Err(
                "glb: its animation has all moments of the video; leave --from, --to and --step out, or name one with --at"
                    .into(),
            );
        }
        let has_moments = !self.at.is_empty();
        let writes = |formats: &[Format]| formats.iter().any(|one| self.format.contains(one));
        let stills = writes(&[Ply, Glb, Spz]);
        let gaussians = stills || writes(&[Canonical, PlySequence]);
        let animation = (self.is_animated(), "glb without --at");
        let [from, to, step] = self.moments.flags();
        let begins = writes(&[PlySequence]) || !has_moments && stills;
        let row = (writes(&[PlySequence]), "ply-sequence");
        let flags = [
            (("--at", has_moments), (stills, "ply, glb, spz")),
            (
                ("--sh-degree", self.sh_degree.is_some()),
                (gaussians, "canonical, ply, ply-sequence, glb, spz"),
            ),
            (("--fps", self.fps.is_some()), animation),
            (("--fidelity", self.fidelity.is_some()), animation),
            (("--nodes", self.nodes.is_some()), animation),
            (
                from,
                (begins, "ply-sequence, and for ply and spz without --at"),
            ),
            (to, row),
            (step, row),
        ];
        refuse_idle(flags)
    }
}

/// What others read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// The scene as it is stored, movers in their canonical frame: `canonical.ply`, the same as the run's `scene.ply`.
    Canonical,
    /// A moment as 3DGS PLY: `scene_at_TIME.ply`.
    Ply,
    /// All moments, a PLY each, alone in their folder: `ply/frame_0000.ply` and so on, for Brush and SuperSplat.
    PlySequence,
    /// Binary glTF with KHR_gaussian_splatting: `scene.glb`; movers as animated rigid parts.
    Glb,
    /// A moment as SPZ version 3, small: `scene_at_TIME.spz`.
    Spz,
    /// Cameras and sharp renders as a nerfstudio data set: `transforms/transforms.json`.
    Transforms,
    /// Cameras and sharp renders as a COLMAP model in text: `colmap/sparse/0/`.
    Colmap,
}

pub(crate) fn run(arguments: &ExportArguments) -> Result<ExitCode, Failure> {
    arguments.check()?;
    let config = Config::of_run(&arguments.run)?.on(arguments.backend);
    let run = checkpoints::open(&arguments.run, &config)?;
    arguments
        .at
        .iter()
        .try_for_each(|time| within(&run, "--at", *time))?;
    let moments = arguments.moments.of(&run)?;
    let stills = if arguments.at.is_empty() {
        &moments[..1]
    } else {
        &arguments.at
    };
    let out = claimed(arguments.out.as_deref(), &arguments.run, "export")?;
    let posed =
        |time| -> Result<Gaussians, Failure> { Ok(cut(run.gaussians(time)?, arguments.sh_degree)) };
    for format in &arguments.format {
        match format {
            Format::Canonical => ply(&out.join("canonical.ply"), &posed(None)?)?,
            Format::Ply => {
                for &time in stills {
                    let path = out.join(format!("scene_at_{time}.ply"));
                    ply(&path, &posed(Some(time))?)?;
                }
            }
            Format::PlySequence => sequence(&moments, &out.join("ply"), posed)?,
            Format::Spz => {
                for &time in stills {
                    let path = out.join(format!("scene_at_{time}.spz"));
                    spz(&path, &posed(Some(time))?, run.survey().scene_size)?;
                }
            }
            Format::Glb if arguments.at.is_empty() => {
                let glb = moving(&run, arguments)?;
                written(&out.join("scene.glb"), |path| io::write_glb(path, &glb))?;
            }
            Format::Glb => {
                for &time in stills {
                    let path = out.join(format!("scene_at_{time}.glb"));
                    let glb = Glb {
                        parts: vec![still("scene", posed(Some(time))?)],
                        seconds: Vec::new(),
                    };
                    written(&path, |path| io::write_glb(path, &glb))?;
                }
            }
            Format::Transforms => transforms(&run, &out.join("transforms"))?,
            Format::Colmap => colmap(&run, &out.join("colmap"))?,
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Writes a file and says so.
fn written(
    path: &Path,
    write: impl FnOnce(&Path) -> Result<(), io::IoError>,
) -> Result<(), Failure> {
    write(path)?;
    let size = std::fs::metadata(path).map_or(0, |file| file.len());
    conclude!("{} ({:.1} MB)", path.display(), size as f64 / 1e6);
    Ok(())
}

/// Gaussians without spherical harmonics over a degree.
fn cut(gaussians: Gaussians, degree: Option<u8>) -> Gaussians {
    let degree = degree.map_or(gaussians.sh_degree, usize::from);
    if degree >= gaussians.sh_degree {
        return gaussians;
    }
    let [width, kept] = [gaussians.sh_degree, degree].map(|d| 3 * (d + 1).pow(2));
    let rows = gaussians.sh.chunks_exact(width);
    Gaussians {
        sh: rows.flat_map(|sh| &sh[..kept]).copied().collect(),
        sh_degree: degree,
        ..gaussians
    }
}

/// Some rows of them.
fn pick(gaussians: &Gaussians, rows: impl Iterator<Item = usize> + Clone) -> Gaussians {
    let width = 3 * (gaussians.sh_degree + 1).pow(2);
    let sh = rows
        .clone()
        .flat_map(|i| &gaussians.sh[i * width..(i + 1) * width]);
    Gaussians {
        means: rows.clone().map(|i| gaussians.means[i]).collect(),
        quats: rows.clone().map(|i| gaussians.quats[i]).collect(),
        log_scales: rows.clone().map(|i| gaussians.log_scales[i]).collect(),
        opacity_logits: rows.clone().map(|i| gaussians.opacity_logits[i]).collect(),
        sh: sh.copied().collect(),
        sh_degree: gaussians.sh_degree,
    }
}

fn sequence(
    moments: &[f32],
    folder: &Path,
    posed: impl Fn(Option<f32>) -> Result<Gaussians, Failure>,
) -> Result<(), Failure> {
    let names = Numbered::new(folder.to_owned(), ("frame_", "ply"), (4, moments.len()));
    names.alone("viewers take a folder as a sequence only where nothing else is in it")?;
    names.clear()?;
    for (index, &time) in moments.iter().enumerate() {
        io::write_ply(&names.path(index), &posed(Some(time))?)?;
    }
    conclude!("{}: {} files", folder.display(), moments.len());
    Ok(())
}

fn ply(path: &Path, gaussians: &Gaussians) -> Result<(), Failure> {
    written(path, |path| io::write_ply(path, gaussians))
}

fn spz(path: &Path, gaussians: &Gaussians, scene_size: f64) -> Result<(), Failure> {
    let mut lost = None;
    written(path, |path| {
        lost = Some(io::write_spz(path, gaussians)?);
        Ok(())
    })?;
    for note in lost
        .iter()
        .flat_map(|lost| lost_in_spz(lost, gaussians.len(), scene_size))
    {
        say!("note: {note}");
    }
    Ok(())
}

/// What an SPZ of so many Gaussians lost, as far as it could be seen.
fn lost_in_spz(lost: &SpzLoss, count: usize, scene_size: f64) -> Vec<String> {
    /// Steps of positions that are seen, as a share of the scene's size: about a pixel of a picture a thousand wide.
    const COARSE: f64 = 1e-3;
    let mut notes = Vec::new();
    if f64::from(lost.position_step) > COARSE * scene_size {
        notes.push(format!(
            "SPZ rounds positions to {} scene units here, where the scene's size is {scene_size:.3}: it has 24 bits for all of them, \
             and the farthest Gaussian is {:.0} units away; ply and glb hold positions as they are",
            lost.position_step, lost.farthest,
        ));
    }
    for (clipped, are) in [
        (
            lost.clipped_scales,
            "are smaller or larger than SPZ holds (e^-10 to e^5.94 scene units)",
        ),
        (
            lost.clipped_colors,
            "have stronger colours than SPZ holds (-0.44 to 1.44 of white, and view-dependent coefficients of -1 to 0.99)",
        ),
    ] {
        if clipped > 0 {
            notes.push(format!(
                "{clipped} of {count} Gaussians {are}, and were brought there"
            ));
        }
    }
    notes
}

fn still(name: &str, gaussians: Gaussians) -> GlbPart {
    GlbPart {
        name: name.to_owned(),
        gaussians,
        motion: None,
    }
}

/// What stands still as one part, and movers as rigid ones; an error where that shows.
fn moving(run: &Run, arguments: &ExportArguments) -> Result<Glb, Failure> {
    let fps = arguments.fps.unwrap_or(24.0);
    let fidelity = arguments.fidelity.unwrap_or(35.0);
    let nodes = arguments.nodes.unwrap_or(256);
    if !(fps.is_finite() && fps > 0.0) {
        return Err(format!("--fps {fps}: a number over 0 is expected").into());
    }
    if fidelity.is_nan() {
        return Err("--fidelity NaN: a number of decibels is expected".into());
    }
    let rigid = run.rigid_parts(fidelity, nodes)?;
    if let Some(psnr) = rigid.psnr.filter(|psnr| *psnr < fidelity) {
        return Err(format!(
            "glb: movers bend. Every Gaussian has a motion of its own, blended of all bases, and glTF moves rigid parts alone: cut \
             into {} of them, the scene comes within {psnr:.1} dB of its own pictures, and {fidelity} are asked for. --fidelity {} \
             takes that, --nodes {} cuts finer, --at TIME writes one moment, and --format ply-sequence all of them as they are",
            rigid.parts.len(),
            psnr.floor(),
            nodes.max(1).saturating_mul(4),
        )
        .into());
    }
    let canonical = cut(run.gaussians(None)?, arguments.sh_degree);
    let fixed = pick(&canonical, run.model().num_dynamic()..canonical.len());
    let mut parts = vec![still("static", fixed)];
    for (index, part) in rigid.parts.iter().enumerate() {
        parts.push(GlbPart {
            name: format!("mover {index}"),
            gaussians: pick(&canonical, part.rows.iter().copied()),
            motion: Some(RigidMotion {
                rotations: part.rotations.clone(),
                translations: part.translations.clone(),
            }),
        });
    }
    if let Some(psnr) = rigid.psnr {
        say!(
            "movers as {} rigid parts: within {psnr:.1} dB of their own pictures",
            rigid.parts.len()
        );
    }
    let first = rigid.times.first().copied().unwrap_or(0.0);
    let seconds = rigid
        .times
        .iter()
        .map(|time| (f64::from(time - first) / fps) as f32);
    Ok(Glb {
        parts,
        seconds: seconds.collect(),
    })
}

/// Sharp renders of all views into `images`, and their cameras as the run has them by now, by file relative to `relative`.
fn pictures(run: &Run, images: &Path, relative: &str) -> Result<Vec<ExportedView>, Failure> {
    let views = run.views();
    let times: Vec<f32> = views.train.iter().map(|view| view.time).collect();
    // With what was found wrong of them, and in the middle of their exposures.
    let found = run.views_at(&times);
    let training = views
        .train
        .iter()
        .zip(found)
        .map(|(view, found)| CameraView {
            cam_from_world: found.cam_from_world,
            ..view.clone()
        });
    let mut exported = Vec::new();
    let sets = [
        ("train", training.collect::<Vec<_>>()),
        ("test", views.test.clone()),
    ];
    for (set, views) in sets {
        let names = Numbered::new(images.join(set), ("", "png"), (5, views.len()));
        names.clear()?;
        for (index, view) in views.into_iter().enumerate() {
            let path = names.path(index);
            let name = path
                .file_name()
                .and_then(|name| name.to_str())
                .unwrap_or_default();
            io::write_png(
                &path,
                &run.render_view(&view.camera, &view.cam_from_world, view.time)?,
            )?;
            exported.push(ExportedView {
                file: format!("{relative}{set}/{name}"),
                camera: view.camera,
                cam_from_world: view.cam_from_world,
                time: view.time,
                is_test: set == "test",
            });
        }
    }
    Ok(exported)
}

/// Means of what stands still and is rather there than not, at most a hundred thousand, for those who start from points.
fn points(run: &Run) -> Result<Vec<SparsePoint>, Failure> {
    const MOST: usize = 100_000;
    let gaussians = run.gaussians(None)?;
    let width = 3 * (gaussians.sh_degree + 1).pow(2);
    let opaque = |i: &usize| gaussians.opacity_logits[*i] > 0.0;
    let rows: Vec<usize> = (run.model().num_dynamic()..gaussians.len())
        .filter(opaque)
        .collect();
    let chosen = rows.iter().step_by(rows.len().div_ceil(MOST).max(1));
    let points = chosen.map(|&i| SparsePoint {
        position: io::glam::Vec3::from_array(gaussians.means[i]).as_dvec3(),
        color: [0, 1, 2].map(|c| (0.282_094_8 * gaussians.sh[i * width + c] + 0.5).clamp(0.0, 1.0)),
    });
    Ok(points.collect())
}

fn transforms(run: &Run, folder: &Path) -> Result<(), Failure> {
    let views = pictures(run, &folder.join("images"), "images/")?;
    io::write_points_ply(&folder.join("points.ply"), &points(run)?)?;
    let path = folder.join("transforms.json");
    io::write_transforms(&path, &views, Some("points.ply"))?;
    conclude!(
        "{}: {} cameras, with sharp renders",
        path.display(),
        views.len()
    );
    Ok(())
}

fn colmap(run: &Run, folder: &Path) -> Result<(), Failure> {
    let views = pictures(run, &folder.join("images"), "")?;
    let model = folder.join("sparse/0");
    io::write_colmap(&model, &views, &points(run)?)?;
    conclude!(
        "{}: {} cameras, with sharp renders",
        model.display(),
        views.len()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_spz_loses_is_told_where_it_could_be_seen() {
        let fine = SpzLoss {
            position_step: 0.5_f32.powi(20),
            farthest: 7.0,
            clipped_scales: 0,
            clipped_colors: 0,
        };
        assert_eq!(lost_in_spz(&fine, 9, 4.0), Vec::<String>::new());
        let coarse = SpzLoss {
            position_step: 0.5_f32.powi(6),
            farthest: 1e5,
            ..fine
        };
        let told = lost_in_spz(&coarse, 9, 4.0).concat();
        for part in ["0.015625 scene units", "100000 units away", "4.000"] {
            assert!(told.contains(part), "{part}: {told}");
        }
        // A scene as large as that does not see the same step.
        assert_eq!(lost_in_spz(&coarse, 9, 1e4), Vec::<String>::new());
        let clipped = SpzLoss {
            clipped_scales: 2,
            clipped_colors: 3,
            ..fine
        };
        let told = lost_in_spz(&clipped, 9, 4.0);
        for (note, parts) in told
            .iter()
            .zip([["2 of 9", "larger"], ["3 of 9", "colours"]])
        {
            assert!(parts.iter().all(|part| note.contains(part)), "{note}");
        }
        assert_eq!(told.len(), 2);
    }
}
