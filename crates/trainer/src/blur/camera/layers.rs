//! A lens without samples: a sharp render cut into layers of depth, each blurred by the disc at its depth, one over the other.
//!
//! It is what others do to pictures with depth. What is hidden in the sharp render stays hidden, also behind an edge that a lens
//! sees past.

use super::Lens;
use crate::settings::TransferKind;
use burn::tensor::module::conv2d;
use burn::tensor::ops::{ConvOptions, PadMode};
use burn::tensor::{Tensor, TensorData};
use host::read;
use splat_core::Rendered;

/// Layers between near and far, evenly in disparity.
const LAYERS: usize = 6;
/// Larger discs are as this, px.
const LARGEST_RADIUS: f64 = 15.0;
/// Under this, px, a disc's variance, a quarter of its square, fits into three pixels.
const SMALL_RADIUS: f64 = std::f64::consts::SQRT_2;
/// Where a curve's straight start ends, in values of the picture.
const TOE: f64 = 0.04045;
/// Light and depth are divided by no smaller share of what covers a pixel.
const LEAST_COVER: f64 = 1e-3;

/// What the lens makes of a sharp render, [H, W, 3]. `focal` is the focal length, px, and `near` and `far` are depths between which
/// the layers lie, scene units.
pub(super) fn layered(
    rendered: &Rendered,
    lens: &Lens,
    focal: f64,
    [near, far]: [f64; 2],
    transfer: TransferKind,
) -> Tensor<3> {
    let [height, width, _] = rendered.output().dims();
    let alpha = rendered.alpha().reshape([height, width, 1]);
    let cover = alpha.clone().clamp_min(LEAST_COVER);
    let depth = rendered.depth().reshape([height, width, 1]) / cover.clone();
    let (first, last) = (1.0 / far, 1.0 / near);
    let step = ((last - first) / (LAYERS - 1) as f64).max(1e-9);
    let place = (depth.clamp_min(1e-6).recip() - first) / step;
    let place = place.clamp(0.0, (LAYERS - 1) as f64);
    // Premultiplied light and what covers it.
    let curve = Curve::of(transfer);
    let color = rendered.color() / cover;
    let light = curve
        .as_ref()
        .map_or(color.clone(), |curve| curve.light(color));
    let light = light * alpha.clone();
    let layered = Tensor::cat(vec![light, alpha.clone()], 2);

    let mut passed = alpha.clone().ones_like();
    let mut sum = layered.clone().zeros_like();
    for layer in (0..LAYERS).rev() {
        // Between two layers what is seen is whole in the farther one, under its share in the nearer.
        let before = place.clone() - layer as f64;
        let nearer = before.clone().greater_equal_elem(1.0);
        let share = (before + 1.0).clamp(0.0, 1.0).mask_fill(nearer, 0.0);
        let at = 1.0 / (first + step * layer as f64);
        let radius = lens.radius_in_image(at, focal);
        let blurred = blurred(layered.clone() * share, radius);
        let covered = blurred.clone().narrow(2, 3, 1).clamp(0.0, 1.0);
        sum = sum + passed.clone() * blurred;
        passed = passed * (-covered + 1.0);
    }
    // What a lens sees past an edge is not known: it is as what is seen there.
    let cover = sum.clone().narrow(2, 3, 1).clamp_min(LEAST_COVER);
    let light = sum.narrow(2, 0, 3) / cover;
    curve.map_or(light.clone(), |curve| curve.value(light)) * alpha
}

/// A picture [H, W, C] blurred by a disc of a radius [1, 1], px, at most [`LARGEST_RADIUS`]. The picture goes on as its border.
fn blurred(picture: Tensor<3>, radius: Tensor<2>) -> Tensor<3> {
    let [height, width, channels] = picture.dims();
    let known: f64 = read(radius.clone().detach()).iter::<f64>().sum();
    if known == 0.0 {
        return picture;
    }
    let options = (&picture.device(), picture.dtype());
    let disc = if known.abs() < SMALL_RADIUS {
        // Pixels do not show it as a disc: any weights with its variance, which have a gradient however small it is.
        let beside = radius.square() * 0.125;
        let along = Tensor::cat(vec![beside.clone(), -beside.clone() * 2.0 + 1.0, beside], 1);
        along.clone().transpose() * along
    } else {
        let radius = radius.abs().clamp_max(LARGEST_RADIUS);
        let reach = (known.abs().min(LARGEST_RADIUS) + 0.5).floor() as usize;
        let side = 2 * reach + 1;
        let away = |i: usize| i as f64 - reach as f64;
        let distances = (0..side * side).map(|i| away(i / side).hypot(away(i % side)));
        let distances = TensorData::new(distances.collect::<Vec<f64>>(), [side, side]);
        // Its rim is a pixel wide.
        let disc = radius + 0.5 - Tensor::<2>::from_data(distances, options);
        let disc = disc.clamp(0.0, 1.0);
        disc.clone() / disc.sum().reshape([1, 1])
    };
    let side = disc.dims()[0];
    let reach = side / 2;
    let planes = picture
        .permute([2, 0, 1])
        .reshape([channels, 1, height, width]);
    let planes = planes.pad([(reach, reach), (reach, reach)], PadMode::Edge);
    let kernel = disc.reshape([1, 1, side, side]);
    let whole = ConvOptions::new([1, 1], [0, 0], [1, 1], 1);
    let blurred = conv2d(planes, kernel, None, whole);
    blurred
        .reshape([channels, height, width])
        .permute([1, 2, 0])
}

/// A curve of sRGB's kind: straight up to [`TOE`], and from there on ((value + offset) / (1 + offset))^gamma.
struct Curve {
    gamma: f64,
    offset: f64,
    /// Light of a value in the straight part, per value.
    slope: f64,
}

impl Curve {
    /// `None` where values are light.
    fn of(transfer: TransferKind) -> Option<Self> {
        match transfer {
            TransferKind::Linear => None,
            TransferKind::Srgb => Some(Self {
                gamma: 2.4,
                offset: 0.055,
                slope: 1.0 / 12.92,
            }),
            TransferKind::Power(gamma) => Some(Self {
                gamma,
                offset: 0.0,
                slope: TOE.powf(gamma - 1.0),
            }),
        }
    }

    fn light(&self, value: Tensor<3>) -> Tensor<3> {
        let start = value.clone().lower_elem(TOE);
        let bent = (value.clone().clamp_min(TOE) + self.offset) / (1.0 + self.offset);
        bent.powf_scalar(self.gamma)
            .mask_where(start, value * self.slope)
    }

    fn value(&self, light: Tensor<3>) -> Tensor<3> {
        let end = TOE * self.slope;
        let start = light.clone().lower_elem(end);
        let bent = light.clone().clamp_min(end).powf_scalar(1.0 / self.gamma);
        let bent = bent * (1.0 + self.offset) - self.offset;
        bent.mask_where(start, light / self.slope)
    }
}

#[cfg(test)]
mod tests {
    use super::super::lens::examples::{FOCAL, ahead, lens, tensor, through_points, values};
    use super::*;
    use splat_core::{Extra, Splats, Transfer, render};

    const SIDE: usize = 48;

    /// A wall of a pattern at a depth, larger than the picture.
    fn wall(depth: f64, pattern: impl Fn(usize, usize) -> f64) -> Splats {
        let side = 60;
        let step = depth / FOCAL;
        let at = |i: usize| (i as f64 - side as f64 / 2.0 + 0.5) * step;
        let cells = || (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
        let n = side * side;
        Splats {
            means: tensor(cells().flat_map(|(x, y)| [at(x), at(y), depth]), [n, 3]),
            quats: tensor([1.0, 0.0, 0.0, 0.0].repeat(n), [n, 4]),
            left_rotations: None,
            log_scales: tensor(vec![(0.8 * step).ln(); 3 * n], [n, 3]),
            opacity_logits: tensor(vec![4.0; n], [n, 1]),
            sh: tensor(cells().flat_map(|(x, y)| [pattern(x, y); 3]), [n, 3]),
        }
    }

    fn stripes(x: usize, y: usize) -> f64 {
        1.2 * ((0.7 * x as f64).sin() * (0.45 * y as f64).cos())
    }

    fn rms(a: &[f64], b: &[f64]) -> f64 {
        let sum: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
        (sum / a.len() as f64).sqrt()
    }

    #[test]
    fn through_a_closed_lens_the_picture_is_the_sharp_one() {
        let rendered =
            render(wall(3.0, stripes), &ahead(SIDE), Extra::default()).expect("a render");
        for transfer in [
            TransferKind::Linear,
            TransferKind::Srgb,
            TransferKind::Power(2.2),
        ] {
            let seen = layered(&rendered, &lens(0.0, 1.0), FOCAL, [2.0, 9.0], transfer);
            let off = rms(&values(seen), &values(rendered.color()));
            assert!(off < 1e-9, "{transfer:?}: {off}");
        }
    }

    /// At the depth of a layer closely, and between two of them as far as so few can tell.
    #[test]
    fn a_wall_out_of_focus_is_what_many_points_of_the_lens_see() {
        for (depth, left) in [(1.0 / 0.366_667, 0.15), (2.5, 0.3), (3.1, 0.6)] {
            let (splats, lens) = (wall(depth, stripes), lens(0.07, 1.0));
            let taken = through_points(splats.clone(), &ahead(SIDE), &lens, Transfer::Srgb);
            let rendered = render(splats, &ahead(SIDE), Extra::default()).expect("a render");
            let seen = layered(&rendered, &lens, FOCAL, [2.0, 6.0], TransferKind::Srgb);
            // Without the border, beyond which the wall goes on.
            let inside = |picture: Tensor<3>| values(picture.narrow(0, 6, 36).narrow(1, 6, 36));
            let taken = inside(taken.color);
            let (sharp, off) = (
                rms(&inside(rendered.color()), &taken),
                rms(&inside(seen), &taken),
            );
            assert!(
                sharp > 0.015 && off < left * sharp,
                "{depth}: {off} of {sharp}"
            );
        }
    }

    /// Its second moments are a disc's, whatever its size.
    #[test]
    fn a_point_spreads_by_the_discs_variance() {
        for radius in [0.01, 0.3, 0.9, 1.3, 3.2, 7.0, 14.0] {
            let side = 41;
            let mut point = vec![0.0; side * side];
            point[side * side / 2] = 1.0;
            let spread = blurred(tensor(point, [side, side, 1]), tensor([radius], [1, 1]));
            let away = |i: usize| (i % side) as f64 - (side / 2) as f64;
            let each = values(spread).into_iter().enumerate();
            let [light, variance] = each.fold([0.0; 2], |[light, variance], (i, v)| {
                [light + v, variance + v * away(i) * away(i)]
            });
            let expected = 0.25 * radius * radius;
            assert!((light - 1.0).abs() < 1e-9, "{radius}");
            assert!(
                (variance / expected - 1.0).abs() < 0.06,
                "{radius}: {variance} {expected}"
            );
        }
    }

    #[test]
    fn the_apertures_gradient_is_that_of_differences() {
        let splats = wall(2.5, stripes);
        let rendered = render(splats, &ahead(SIDE), Extra::default()).expect("a render");
        let loss = |lens: &Lens| {
            let seen = layered(&rendered, lens, FOCAL, [2.0, 6.0], TransferKind::Srgb);
            seen.square().mean()
        };
        // Discs of pixels, and of less than half a pixel in every layer.
        for aperture in [0.07, 0.004] {
            let mut at = lens(aperture, 1.0);
            at.aperture = at.aperture.require_grad();
            let grads = loss(&at).backward();
            let found = values(Tensor::<2>::from_inner(
                at.aperture.grad(&grads).expect("a gradient"),
            ));
            let value = |aperture| values(loss(&lens(aperture, 1.0)))[0];
            let step = 1e-6;
            let numeric = (value(aperture + step) - value(aperture - step)) / (2.0 * step);
            let off = (found[0] - numeric).abs();
            assert!(
                numeric != 0.0 && off < 1e-5 * numeric.abs(),
                "{} {numeric}",
                found[0]
            );
        }
    }
}
