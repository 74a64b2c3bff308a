//! What the camera saw, from a sharp image and the blur of every pixel, and the backward of that.
//!
//! With s = Σ_j k_j over the j inside the image, `B_c = Σ_j k_j I_c(x + Δ_j) / s` is the blurred image,
//! and the picture is `C = m B + (1 - m) I`. Two sums over a kernel that losses want come in the same
//! pass: the centroid `m Σ_j k_j Δ_j` and the weight of the centre.
//!
//! Backward, for the gradient g of B: `dk_j = Σ_c g_c / s (I_c(x + Δ_j) - B_c)` for j inside, else 0,
//! and `dI_c(x + Δ_j) += g_c / s k_j`.
//!
//! Images are copied once into planes with a border of K/2 zeros, so that a window's row is K values
//! in a row of memory. A fourth plane holds 1 inside the image, and so s is one more channel.

use rayon::prelude::*;
use tracing::trace_span;

use host::{Real, filled, vectorized};

/// Channels of the output: picture 3, centroid 2 (x before y), centre weight, intensity.
pub(crate) const CHANNELS: usize = 7;

/// Rows of the piece of an image that one task works on.
const BAND: usize = 8;

/// Where the weights inside the image sum to less, the pixel keeps its colour.
pub(crate) const LEAST_SUM: f64 = 1e-12;

/// Height, width and kernel side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BlurSize {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) kernel: usize,
}

impl BlurSize {
    fn padded_width(self) -> usize {
        self.width + self.kernel - 1
    }

    /// Values of a pixel of the field: its kernel and its intensity.
    fn entries(self) -> usize {
        self.kernel * self.kernel + 1
    }
}

/// Runs `$body` with the constant `$k` equal to the kernel side, and with the machine's best
/// vector instructions.
macro_rules! with_kernel_size {
    ($size:expr, $function:ident::<$float:ty, _>($($argument:expr),* $(,)?)) => {
        match $size.kernel {
            1 => $function::<$float, 1>($($argument),*),
            3 => $function::<$float, 3>($($argument),*),
            5 => $function::<$float, 5>($($argument),*),
            7 => $function::<$float, 7>($($argument),*),
            9 => $function::<$float, 9>($($argument),*),
            11 => $function::<$float, 11>($($argument),*),
            13 => $function::<$float, 13>($($argument),*),
            15 => $function::<$float, 15>($($argument),*),
            other => unreachable!("kernel size {other} is refused by the op"),
        }
    };
}

/// Picture, centroid, centre weight and intensity, `[H, W, 7]`, of `image` `[H, W, 3]` and `field`
/// `[H, W, K² + 1]`: every pixel's kernel and intensity.
pub(crate) fn composite<T: Real>(image: &[T], field: &[T], size: BlurSize) -> Vec<T> {
    let _span = trace_span!("composite").entered();
    let mut output = filled(T::ZERO, size.height * size.width * CHANNELS);
    if output.is_empty() {
        return output;
    }
    let planes = Planes::new(image, size);
    output
        .par_chunks_mut(BAND * size.width * CHANNELS)
        .zip(field.par_chunks(BAND * size.width * size.entries()))
        .enumerate()
        .for_each(|(band, (output, field))| {
            vectorized(
                #[inline(always)]
                || {
                    with_kernel_size!(
                        size,
                        band_forward::<T, _>(&planes, field, band * BAND, output)
                    );
                },
            );
        });
    output
}

/// Gradients of image and field, each only where it is wanted.
pub(crate) fn composite_backward<T: Real>(
    image: &[T],
    field: &[T],
    gradient: &[T],
    size: BlurSize,
    wanted: [bool; 2],
) -> [Option<Vec<T>>; 2] {
    let _span = trace_span!("composite backward").entered();
    let [image_wanted, field_wanted] = wanted;
    let mut field_gradient = filled(T::ZERO, if field_wanted { field.len() } else { 0 });
    if image.is_empty() {
        return [
            image_wanted.then(Vec::new),
            field_wanted.then_some(field_gradient),
        ];
    }
    let planes = Planes::new(image, size);
    let bands = size.height.div_ceil(BAND);
    let mut field_gradients: Vec<&mut [T]> = if field_wanted {
        field_gradient
            .chunks_mut(BAND * size.width * size.entries())
            .collect()
    } else {
        (0..bands).map(|_| Default::default()).collect()
    };
    let image_gradients: Vec<Vec<T>> = field_gradients
        .par_iter_mut()
        .enumerate()
        .map(|(band, field_gradient)| {
            let rows = BAND.min(size.height - band * BAND);
            let mut image_gradient = if image_wanted {
                vec![T::ZERO; 3 * (rows + size.kernel - 1) * size.padded_width()]
            } else {
                Vec::new()
            };
            let pixels = band * BAND * size.width..(band * BAND + rows) * size.width;
            let field = &field[pixels.start * size.entries()..pixels.end * size.entries()];
            let gradient = &gradient[pixels.start * CHANNELS..pixels.end * CHANNELS];
            vectorized(
                #[inline(always)]
                || {
                    with_kernel_size!(
                        size,
                        band_backward::<T, _>(
                            &planes,
                            field,
                            gradient,
                            band * BAND,
                            field_gradient,
                            &mut image_gradient,
                        )
                    );
                },
            );
            image_gradient
        })
        .collect();
    [
        image_wanted.then(|| merge_bands(&image_gradients, size)),
        field_wanted.then_some(field_gradient),
    ]
}

/// The image's three channels and the indicator of its inside, as planes with borders.
struct Planes<T> {
    values: Vec<T>,
    size: BlurSize,
}

impl<T: Real> Planes<T> {
    fn new(image: &[T], size: BlurSize) -> Self {
        let half = size.kernel / 2;
        let stride = size.padded_width();
        let plane = (size.height + size.kernel - 1) * stride;
        let mut values = filled(T::ZERO, 4 * plane);
        for (y, row) in image.chunks_exact(size.width * 3).enumerate() {
            let start = (y + half) * stride + half;
            for (x, pixel) in row.chunks_exact(3).enumerate() {
                for (channel, &value) in pixel.iter().enumerate() {
                    values[channel * plane + start + x] = value;
                }
                values[3 * plane + start + x] = T::ONE;
            }
        }
        Self { values, size }
    }

    /// The K values of a channel's window row that starts at padded position `(y, x)`.
    #[inline(always)]
    fn window<const K: usize>(&self, channel: usize, y: usize, x: usize) -> &[T; K] {
        let stride = self.size.padded_width();
        let start = (channel * (self.size.height + K - 1) + y) * stride + x;
        chunk(&self.values[start..])
    }

    /// The colour of a pixel.
    #[inline(always)]
    fn pixel<const K: usize>(&self, y: usize, x: usize) -> [T; 3] {
        [0, 1, 2].map(|c| self.window::<K>(c, y + K / 2, x)[K / 2])
    }
}

/// The first K values.
#[inline(always)]
fn chunk<T, const K: usize>(values: &[T]) -> &[T; K] {
    values.first_chunk().expect("the slice holds K values")
}

/// Sums over the kernel of a pixel.
struct Window<T> {
    /// Σ k I / s over the weights inside the image, or the pixel's own colour.
    mean: [T; 3],
    /// s, or 0 where it is too small.
    inside: T,
    /// Σ k Δ, x before y.
    shift: [T; 2],
}

impl<T: Real> Window<T> {
    #[inline(always)]
    fn new<const K: usize>(planes: &Planes<T>, kernel: &[T], y: usize, x: usize) -> Self {
        // One accumulator per column of the window: they are the lanes of a vector.
        let mut sums = [[T::ZERO; K]; 4];
        let mut columns = [T::ZERO; K];
        let mut vertical = [T::ZERO; K];
        for ky in 0..K {
            let weights: &[T; K] = chunk(&kernel[ky * K..]);
            for (channel, sum) in sums.iter_mut().enumerate() {
                let window = planes.window::<K>(channel, y + ky, x);
                for kx in 0..K {
                    sum[kx] += weights[kx] * window[kx];
                }
            }
            for kx in 0..K {
                columns[kx] += weights[kx];
                vertical[kx] += weights[kx] * offset::<T, K>(ky);
            }
        }
        for (kx, sum) in columns.iter_mut().enumerate() {
            *sum = *sum * offset::<T, K>(kx);
        }
        let fold = |lanes: [T; K]| lanes.into_iter().fold(T::ZERO, |a, b| a + b);
        let [r, g, b, inside] = sums.map(fold);
        let shift = [fold(columns), fold(vertical)];
        if inside < T::of(LEAST_SUM) {
            return Self {
                mean: planes.pixel::<K>(y, x),
                inside: T::ZERO,
                shift,
            };
        }
        Self {
            mean: [r / inside, g / inside, b / inside],
            inside,
            shift,
        }
    }
}

/// Distance of column or row `k` of a window from its centre, px.
#[inline(always)]
fn offset<T: Real, const K: usize>(k: usize) -> T {
    T::of(k as f64 - (K / 2) as f64)
}

#[inline(always)]
fn band_forward<T: Real, const K: usize>(
    planes: &Planes<T>,
    field: &[T],
    first_row: usize,
    output: &mut [T],
) {
    let width = planes.size.width;
    for (i, (output, field)) in output
        .chunks_exact_mut(CHANNELS)
        .zip(field.chunks_exact(K * K + 1))
        .enumerate()
    {
        let (y, x) = (first_row + i / width, i % width);
        let (kernel, m) = (&field[..K * K], field[K * K]);
        let window = Window::new::<K>(planes, kernel, y, x);
        let own = planes.pixel::<K>(y, x);
        for c in 0..3 {
            // Exact at both ends, and where blurred and sharp agree.
            output[c] = if m < T::of(0.5) {
                own[c] + m * (window.mean[c] - own[c])
            } else {
                window.mean[c] - (T::ONE - m) * (window.mean[c] - own[c])
            };
        }
        output[3] = m * window.shift[0];
        output[4] = m * window.shift[1];
        output[5] = kernel[K * K / 2];
        output[6] = m;
    }
}

/// Backward of a band of rows. The gradient of the image goes to planes of the band's own, with
/// borders, because the windows of neighbouring bands overlap. An empty slice is not wanted.
#[inline(always)]
fn band_backward<T: Real, const K: usize>(
    planes: &Planes<T>,
    field: &[T],
    gradient: &[T],
    first_row: usize,
    field_gradient: &mut [T],
    image_gradient: &mut [T],
) {
    let width = planes.size.width;
    let stride = planes.size.padded_width();
    let plane = image_gradient.len() / 3;
    for (i, (g, field)) in gradient
        .chunks_exact(CHANNELS)
        .zip(field.chunks_exact(K * K + 1))
        .enumerate()
    {
        let (row, x) = (i / width, i % width);
        let y = first_row + row;
        let (weights, m) = (&field[..K * K], field[K * K]);
        let window = Window::new::<K>(planes, weights, y, x);
        let own = planes.pixel::<K>(y, x);
        let drawn = window.inside > T::ZERO;
        let of_mean: [T; 3] = if drawn {
            std::array::from_fn(|c| m * g[c] / window.inside)
        } else {
            [T::ZERO; 3]
        };
        if !field_gradient.is_empty() {
            let target = &mut field_gradient[i * (K * K + 1)..][..K * K + 1];
            let level = of_mean[0] * window.mean[0]
                + of_mean[1] * window.mean[1]
                + of_mean[2] * window.mean[2];
            let of_shift = [m * g[3], m * g[4]];
            for ky in 0..K {
                let target: &mut [T; K] = target[ky * K..]
                    .first_chunk_mut()
                    .expect("a kernel has K rows");
                let [r, green, b, inside] = [0, 1, 2, 3].map(|c| planes.window::<K>(c, y + ky, x));
                let vertical = of_shift[1] * offset::<T, K>(ky);
                for kx in 0..K {
                    let moment = of_mean[0] * r[kx] + of_mean[1] * green[kx] + of_mean[2] * b[kx];
                    target[kx] = (moment - level) * inside[kx]
                        + (of_shift[0] * offset::<T, K>(kx) + vertical);
                }
            }
            target[K * K / 2] += g[5];
            let mut of_intensity = g[3] * window.shift[0] + g[4] * window.shift[1] + g[6];
            for c in 0..3 {
                of_intensity += g[c] * (window.mean[c] - own[c]);
            }
            target[K * K] = of_intensity;
        }
        if plane > 0 {
            let rest = if drawn { T::ONE - m } else { T::ONE };
            for c in 0..3 {
                image_gradient[c * plane + (row + K / 2) * stride + x + K / 2] += rest * g[c];
            }
            for ky in 0..K {
                let weights: &[T; K] = chunk(&weights[ky * K..]);
                for (c, &g) in of_mean.iter().enumerate() {
                    let target: &mut [T; K] = image_gradient[c * plane + (row + ky) * stride + x..]
                        .first_chunk_mut()
                        .expect("the border is K/2 wide");
                    for kx in 0..K {
                        target[kx] += weights[kx] * g;
                    }
                }
            }
        }
    }
}

/// Adds the bands' planes, in the order of the bands, and drops their borders: `[H, W, 3]`.
fn merge_bands<T: Real>(bands: &[Vec<T>], size: BlurSize) -> Vec<T> {
    let half = size.kernel / 2;
    let stride = size.padded_width();
    let mut output = filled(T::ZERO, size.height * size.width * 3);
    for (band, values) in bands.iter().enumerate() {
        let plane = values.len() / 3;
        for row in 0..plane / stride {
            let Some(y) = (band * BAND + row).checked_sub(half) else {
                continue;
            };
            if y >= size.height {
                break;
            }
            let target = &mut output[y * size.width * 3..][..size.width * 3];
            for (x, pixel) in target.chunks_exact_mut(3).enumerate() {
                for (c, value) in pixel.iter_mut().enumerate() {
                    *value += values[c * plane + row * stride + half + x];
                }
            }
        }
    }
    output
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(count: usize, seed: usize) -> Vec<f64> {
        (0..count)
            .map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f64 / 10_007.0)
            .collect()
    }

    /// Field of random kernels, not normalised, and intensities.
    fn field(size: BlurSize) -> Vec<f64> {
        values(size.height * size.width * size.entries(), 2)
    }

    fn naive(image: &[f64], field: &[f64], size: BlurSize) -> Vec<f64> {
        let (half, entries) = (size.kernel as isize / 2, size.kernel * size.kernel);
        let mut output = Vec::new();
        for y in 0..size.height as isize {
            for x in 0..size.width as isize {
                let pixel = (y * size.width as isize + x) as usize;
                let own = &field[pixel * (entries + 1)..][..entries + 1];
                let m = own[entries];
                let (mut sum, mut color, mut shift) = (0.0, [0.0; 3], [0.0; 2]);
                for (j, weight) in own[..entries].iter().enumerate() {
                    let dy = (j / size.kernel) as isize - half;
                    let dx = (j % size.kernel) as isize - half;
                    let (sy, sx) = (y + dy, x + dx);
                    shift[0] += m * weight * dx as f64;
                    shift[1] += m * weight * dy as f64;
                    let inside = (0..size.height as isize).contains(&sy)
                        && (0..size.width as isize).contains(&sx);
                    if inside {
                        let source = (sy * size.width as isize + sx) as usize * 3;
                        sum += weight;
                        for c in 0..3 {
                            color[c] += weight * image[source + c];
                        }
                    }
                }
                output
                    .extend((0..3).map(|c| m * color[c] / sum + (1.0 - m) * image[pixel * 3 + c]));
                output.extend(shift);
                output.extend([own[entries / 2], m]);
            }
        }
        output
    }

    #[test]
    fn it_is_the_mean_over_the_window_inside_the_image() {
        for kernel in [1, 3, 5, 7, 9, 11, 13, 15] {
            for (height, width) in [(1, 1), (1, 9), (7, 2), (19, 12)] {
                let size = BlurSize {
                    height,
                    width,
                    kernel,
                };
                let image = values(height * width * 3, 1);
                let field = field(size);
                let output = composite(&image, &field, size);
                for (i, (a, b)) in output.iter().zip(naive(&image, &field, size)).enumerate() {
                    assert!(
                        (a - b).abs() < 1e-12 * (1.0 + b.abs()),
                        "{size:?} at {i}: {a} against {b}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_pixel_without_weight_inside_keeps_its_colour() {
        // One pixel, whose kernel lies outside the image altogether.
        let size = BlurSize {
            height: 1,
            width: 1,
            kernel: 3,
        };
        let (image, mut field) = ([0.1, 0.2, 0.3], [0.125; 10]);
        field[4] = 0.0;
        field[9] = 0.75;
        assert_eq!(composite(&image, &field, size)[..3], image);
        let gradient = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0];
        let [image_gradient, field_gradient] =
            composite_backward(&image, &field, &gradient, size, [true, true]);
        assert_eq!(image_gradient, Some(vec![1.0, 2.0, 3.0]));
        assert_eq!(field_gradient, Some(vec![0.0; 10]));
    }
}
