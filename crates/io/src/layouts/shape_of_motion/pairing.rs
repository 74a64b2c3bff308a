//! Which camera of the COLMAP model belongs to which file, by name.

use std::collections::{BTreeMap, BTreeSet};

use crate::IoError;
use crate::colmap::Model;
use crate::error::list_names;
use crate::folder::stem_of;
use crate::plan::time_between;

/// Which of the model's images belongs to which file.
#[derive(Debug, PartialEq)]
pub(super) struct Pairing {
    /// For each training frame.
    pub(super) training: Vec<usize>,
    /// For each test view, with its time; empty when the model has none.
    pub(super) test: Vec<(usize, f32)>,
}

/// Finds each file's camera by name.
///
/// - The model names the training frames and no others: plain names.
/// - The model names images beyond `images/`: it holds a stereo pair per instant, numbers 2 i left and
///   2 i + 1 right (also written `{i}_left` and `{i}_right`), and training frames are left. The files
///   are numbered by the instant, i, or as in the model. Files whose names are no numbers count in
///   their order.
/// - Without test pictures, whose numbers would tell the two apart, files have the cameras of their own names where all of them are
///   in the model: a video that was cut after its poses were found looks the same.
/// - Anything else is an error with the difference.
pub(super) fn pair(
    stems: &[String],
    test_stems: &[String],
    model: &Model,
    notes: &mut Vec<String>,
) -> Result<Pairing, IoError> {
    let mut by_stem = BTreeMap::new();
    for (at, image) in model.images.iter().enumerate() {
        if by_stem.insert(stem_of(&image.name), at).is_some() {
            let what = format!("two images are called {}", stem_of(&image.name));
            return Err(IoError::names(&model.images_path, what));
        }
    }
    let beyond: Vec<_> = by_stem
        .keys()
        .filter(|s| !stems.iter().any(|t| t == *s))
        .collect();
    let without: Vec<_> = stems
        .iter()
        .filter(|s| !by_stem.contains_key(s.as_str()))
        .collect();

    if beyond.is_empty() && without.is_empty() {
        if !test_stems.is_empty() {
            notes.push("images_test/ is ignored: the COLMAP model has no cameras for it".into());
        }
        return Ok(Pairing {
            training: stems.iter().map(|s| by_stem[s.as_str()]).collect(),
            test: Vec::new(),
        });
    }
    if beyond.is_empty() {
        let difference = format!("no camera for {} of images/", list_names(&without));
        return Err(IoError::names(&model.images_path, difference));
    }

    if without.is_empty() && test_stems.is_empty() {
        notes.push(format!(
            "{} images of the COLMAP model are not in images/: frames have the cameras of their own names (where the model has \
             stereo pairs, numbered 2 i and 2 i + 1, call the frames i_left, or give images_test/)",
            beyond.len()
        ));
        return Ok(Pairing {
            training: stems.iter().map(|s| by_stem[s.as_str()]).collect(),
            test: Vec::new(),
        });
    }

    let mut by_number = BTreeMap::new();
    for (stem, &at) in &by_stem {
        let Some(number) = model_number(stem) else {
            let difference = format!(
                "{} are in the model and not in images/, and {stem} is no number, so that it \
                 cannot be told which are left (even) and which are right (odd)",
                list_names(&beyond)
            );
            return Err(IoError::names(&model.images_path, difference));
        };
        if by_number.insert(number, at).is_some() {
            let what = format!("two images have the number {number}");
            return Err(IoError::names(&model.images_path, what));
        }
    }
    stereo(stems, test_stems, &by_number)
        .map_err(|difference| IoError::names(&model.images_path, difference))
        .inspect(|pairing| {
            let right = by_number.keys().filter(|n| *n % 2 == 1).count();
            if pairing.test.is_empty() && right > 0 {
                notes.push(format!(
                    "no images_test/ for the {right} right cameras: no test views"
                ));
            }
        })
}

/// The even and odd rule, over the model's images by number. The error is the difference.
fn stereo(
    stems: &[String],
    test_stems: &[String],
    by_number: &BTreeMap<u64, usize>,
) -> Result<Pairing, String> {
    let as_in_model = (numbers(stems), numbers(test_stems));
    // A number too large to be doubled stays one that no model has.
    let doubled = |numbers: &[u64], odd: u64| -> Vec<u64> {
        let double = |n: &u64| n.saturating_mul(2).saturating_add(odd);
        numbers.iter().map(double).collect()
    };
    let by_instant = (doubled(&as_in_model.0, 0), doubled(&as_in_model.1, 1));
    let differ = |both: &(Vec<u64>, Vec<u64>)| difference(&both.0, &both.1, by_number);
    let (left, right) = match differ(&by_instant) {
        None => by_instant,
        Some(_) if differ(&as_in_model).is_none() => as_in_model,
        Some(difference) => return Err(difference),
    };
    let instants: Vec<_> = left.iter().map(|&n| n as f64).collect();
    let time = |right: u64| time_between((right - 1) as f64, &instants);
    Ok(Pairing {
        training: left.iter().map(|n| by_number[n]).collect(),
        test: right.iter().map(|&n| (by_number[&n], time(n))).collect(),
    })
}

/// How the numbers that the files ask for differ from the model's; None when they do not.
fn difference(left: &[u64], right: &[u64], by_number: &BTreeMap<u64, usize>) -> Option<String> {
    let of_parity = |odd: u64| -> BTreeSet<u64> {
        by_number.keys().copied().filter(|n| n % 2 == odd).collect()
    };
    let mut parts = Vec::new();
    for (asked, odd, folder) in [(left, 0, "images/"), (right, 1, "images_test/")] {
        let (asked, there) = (BTreeSet::from_iter(asked.iter().copied()), of_parity(odd));
        // Right cameras without test views are no harm.
        if odd == 1 && asked.is_empty() {
            continue;
        }
        let names = |a: &BTreeSet<u64>, b: &BTreeSet<u64>| -> Vec<String> {
            a.difference(b).map(|n| format!("{n:05}")).collect()
        };
        let (no_camera, no_file) = (names(&asked, &there), names(&there, &asked));
        if !no_camera.is_empty() {
            let list = list_names(&no_camera);
            parts.push(format!(
                "{folder} needs cameras {list}, which the model lacks"
            ));
        }
        if !no_file.is_empty() {
            let list = list_names(&no_file);
            parts.push(format!(
                "the model has cameras {list} without a file in {folder}"
            ));
        }
    }
    (!parts.is_empty()).then(|| {
        format!(
            "{} (left frames have even numbers 2 i in the model, right ones 2 i + 1)",
            parts.join("; ")
        )
    })
}

/// The files' numbers; their positions when a name is no number.
fn numbers(stems: &[String]) -> Vec<u64> {
    let parsed: Option<Vec<_>> = stems
        .iter()
        .map(|stem| {
            let stem = stem.strip_suffix("_left").unwrap_or(stem);
            digits(stem.strip_suffix("_right").unwrap_or(stem))
        })
        .collect();
    parsed.unwrap_or_else(|| (0..stems.len() as u64).collect())
}

fn model_number(stem: &str) -> Option<u64> {
    if let Some(instant) = stem.strip_suffix("_left") {
        return digits(instant)?.checked_mul(2);
    }
    if let Some(instant) = stem.strip_suffix("_right") {
        return digits(instant)?.checked_mul(2)?.checked_add(1);
    }
    digits(stem)
}

fn digits(text: &str) -> Option<u64> {
    let all = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    all.then(|| text.parse().ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::colmap::ModelImage;

    fn model(names: &[&str]) -> Model {
        let image = |name: &&str| ModelImage {
            name: (*name).into(),
            camera_id: 1,
            cam_from_world: glam::DAffine3::IDENTITY,
        };
        Model {
            cameras: BTreeMap::new(),
            images: names.iter().map(image).collect(),
            points: Vec::new(),
            cameras_path: "cameras.bin".into(),
            images_path: "images.bin".into(),
        }
    }

    fn paired(train: &[&str], test: &[&str], names: &[&str]) -> Result<Pairing, String> {
        let stems = |s: &[&str]| s.iter().map(|s| (*s).to_string()).collect::<Vec<_>>();
        pair(&stems(train), &stems(test), &model(names), &mut Vec::new()).map_err(|e| e.to_string())
    }

    fn is(training: &[usize], test: &[(usize, f32)]) -> Result<Pairing, String> {
        Ok(Pairing {
            training: training.into(),
            test: test.into(),
        })
    }

    #[test]
    fn plain_names_when_the_sets_are_equal() {
        let names = ["b.png", "a.jpg", "c.png"];
        assert_eq!(
            paired(&["a", "b", "c"], &["a"], &names),
            is(&[1, 0, 2], &[])
        );
        // Numbers too: equal sets are never read as left and right.
        assert_eq!(
            paired(&["0", "1"], &[], &["0.png", "1.png"]),
            is(&[0, 1], &[])
        );
    }

    #[test]
    fn even_is_left_and_odd_is_right() {
        let names = ["00000.png", "00001.png", "00002.png", "00003.png"];
        let both = is(&[0, 2], &[(1, 0.0), (3, 1.0)]);
        assert_eq!(
            paired(&["00000", "00001"], &["00000", "00001"], &names),
            both
        );
        assert_eq!(
            paired(&["0_left", "1_left"], &["0_right", "1_right"], &names),
            both
        );
        let sides = ["0_left.jpg", "0_right.jpg", "1_left.jpg", "1_right.jpg"];
        assert_eq!(
            paired(&["00000", "00001"], &["00000", "00001"], &sides),
            both
        );
        // Files numbered as in the model, and files whose names are no numbers.
        assert_eq!(
            paired(&["00000", "00002"], &["00001", "00003"], &names),
            both
        );
        assert_eq!(paired(&["a", "b"], &["a", "b"], &names), both);
        // Without test views only what the names say.
        assert_eq!(paired(&["0_left", "1_left"], &[], &names), is(&[0, 2], &[]));
        assert_eq!(paired(&["a", "b"], &[], &names), is(&[0, 2], &[]));
        assert_eq!(paired(&["00000", "00001"], &[], &names), is(&[0, 1], &[]));
    }

    #[test]
    fn a_video_that_was_cut_keeps_its_cameras() {
        let names = ["0.png", "1.png", "2.png", "3.png", "4.png", "5.png"];
        assert_eq!(paired(&["0", "1", "2"], &[], &names), is(&[0, 1, 2], &[]));
        assert_eq!(paired(&["2", "3"], &[], &names), is(&[2, 3], &[]));
        let names = ["a.png", "b.png"];
        assert_eq!(paired(&["b"], &[], &names), is(&[1], &[]));
    }

    #[test]
    fn fewer_right_views_keep_their_instants() {
        let names = ["0.png", "2.png", "4.png", "5.png"];
        assert_eq!(
            paired(&["0", "1", "2"], &["2"], &names),
            is(&[0, 1, 2], &[(3, 2.0)])
        );
    }

    #[test]
    fn other_names_are_an_error_with_the_difference() {
        let error = |train: &[&str], test: &[&str], names: &[&str]| {
            paired(train, test, names).expect_err("names that do not fit")
        };
        let text = error(&["00000", "00001"], &[], &["00000.png"]);
        assert!(text.contains("no camera for 00001"), "{text}");
        let text = error(
            &["0", "1", "2"],
            &["0"],
            &["0.png", "1.png", "2.png", "7.png"],
        );
        assert!(text.contains("images/ needs cameras 00004"), "{text}");
        assert!(
            text.contains("cameras 00007 without a file in images_test/"),
            "{text}"
        );
        let text = error(&["a"], &["a"], &["a.png", "b.png"]);
        assert!(text.contains("b are in the model"), "{text}");
        let text = error(&["a"], &[], &["x/a.png", "y/a.png"]);
        assert!(text.contains("two images"), "{text}");
        let text = error(&["18446744073709551615"], &[], &["0.png", "1.png"]);
        assert!(text.contains("needs cameras"), "{text}");
    }
}
