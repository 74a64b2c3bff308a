//! The per-pixel blur and its backward.
//!
//! Forward: with s = Σ_j k_j over the j inside the image, `B_c = Σ_j k_j I_c(x + Δ_j) / s`.
//! Backward, for the gradient g of B: `dk_j = Σ_c g_c / s (I_c(x + Δ_j) - B_c)` for j inside, else 0,
//! and `dI_c(x + Δ_j) += g_c / s k_j`.
//!
//! Images are copied once into planes with a border of K/2 zeros, so that a window's row is K values
//! in a row of memory. A fourth plane holds 1 inside the image, and so s is one more channel.

use rayon::prelude::*;

use super::Real;

/// Rows of the piece of an image that one task works on.
const BAND: usize = 8;

/// Where the weights inside the image sum to less, the pixel keeps its colour.
const LEAST_SUM: f64 = 1e-12;

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

/// Blurs `image` `[H, W, 3]` with `kernel` `[H, W, K * K]`.
pub(crate) fn blur<T: Real>(image: &[T], kernel: &[T], size: BlurSize) -> Vec<T> {
    let mut output = vec![T::ZERO; image.len()];
    if output.is_empty() {
        return output;
    }
    let planes = Planes::new(image, size);
    let arch = pulp::Arch::new();
    output
        .par_chunks_mut(BAND * size.width * 3)
        .zip(kernel.par_chunks(BAND * size.width * size.kernel * size.kernel))
        .enumerate()
        .for_each(|(band, (output, kernel))| {
            arch.dispatch(
                #[inline(always)]
                || {
                    with_kernel_size!(
                        size,
                        blur_band::<T, _>(&planes, kernel, band * BAND, output)
                    );
                },
            );
        });
    output
}

/// Gradients of image and kernel, each only where it is wanted.
pub(crate) fn blur_backward<T: Real>(
    image: &[T],
    kernel: &[T],
    gradient: &[T],
    size: BlurSize,
    wanted: [bool; 2],
) -> [Option<Vec<T>>; 2] {
    let [image_wanted, kernel_wanted] = wanted;
    let mut kernel_gradient = vec![T::ZERO; if kernel_wanted { kernel.len() } else { 0 }];
    if image.is_empty() {
        return [
            image_wanted.then(Vec::new),
            kernel_wanted.then_some(kernel_gradient),
        ];
    }
    let planes = Planes::new(image, size);
    let arch = pulp::Arch::new();
    let entries = BAND * size.width * size.kernel * size.kernel;
    let bands = size.height.div_ceil(BAND);
    let mut kernel_gradients: Vec<&mut [T]> = if kernel_wanted {
        kernel_gradient.chunks_mut(entries).collect()
    } else {
        (0..bands).map(|_| Default::default()).collect()
    };
    let image_gradients: Vec<Vec<T>> = kernel_gradients
        .par_iter_mut()
        .enumerate()
        .map(|(band, kernel_gradient)| {
            let rows = BAND.min(size.height - band * BAND);
            let mut image_gradient = if image_wanted {
                vec![T::ZERO; 3 * (rows + size.kernel - 1) * size.padded_width()]
            } else {
                Vec::new()
            };
            let pixels = band * BAND * size.width..(band * BAND + rows) * size.width;
            let square = size.kernel * size.kernel;
            let kernel = &kernel[pixels.start * square..pixels.end * square];
            let gradient = &gradient[pixels.start * 3..pixels.end * 3];
            arch.dispatch(
                #[inline(always)]
                || {
                    with_kernel_size!(
                        size,
                        backward_band::<T, _>(
                            &planes,
                            kernel,
                            gradient,
                            band * BAND,
                            kernel_gradient,
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
        kernel_wanted.then_some(kernel_gradient),
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
        let mut values = vec![T::ZERO; 4 * plane];
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
}

/// The first K values.
#[inline(always)]
fn chunk<T, const K: usize>(values: &[T]) -> &[T; K] {
    values.first_chunk().expect("the slice holds K values")
}

/// A pixel's window means and the sum of its weights inside the image.
#[inline(always)]
fn window_mean<T: Real, const K: usize>(
    planes: &Planes<T>,
    kernel: &[T],
    y: usize,
    x: usize,
) -> ([T; 3], T) {
    // One accumulator per column of the window: they are the lanes of a vector.
    let mut sums = [[T::ZERO; K]; 4];
    for ky in 0..K {
        let weights: &[T; K] = chunk(&kernel[ky * K..]);
        for (channel, sum) in sums.iter_mut().enumerate() {
            let window = planes.window::<K>(channel, y + ky, x);
            for kx in 0..K {
                sum[kx] += weights[kx] * window[kx];
            }
        }
    }
    let [r, g, b, sum] = sums.map(|lanes| lanes.into_iter().fold(T::ZERO, |a, b| a + b));
    if sum < T::from_f64(LEAST_SUM) {
        let pixel = [0, 1, 2].map(|c| planes.window::<K>(c, y + K / 2, x)[K / 2]);
        return (pixel, T::ZERO);
    }
    ([r / sum, g / sum, b / sum], sum)
}

#[inline(always)]
fn blur_band<T: Real, const K: usize>(
    planes: &Planes<T>,
    kernel: &[T],
    first_row: usize,
    output: &mut [T],
) {
    let width = planes.size.width;
    for (i, pixel) in output.chunks_exact_mut(3).enumerate() {
        let (y, x) = (first_row + i / width, i % width);
        let (mean, _) = window_mean::<T, K>(planes, &kernel[i * K * K..][..K * K], y, x);
        pixel.copy_from_slice(&mean);
    }
}

/// Backward of a band of rows. The gradient of the image goes to planes of the band's own, with
/// borders, because the windows of neighbouring bands overlap. An empty slice is not wanted.
#[inline(always)]
fn backward_band<T: Real, const K: usize>(
    planes: &Planes<T>,
    kernel: &[T],
    gradient: &[T],
    first_row: usize,
    kernel_gradient: &mut [T],
    image_gradient: &mut [T],
) {
    let width = planes.size.width;
    let stride = planes.size.padded_width();
    let plane = image_gradient.len() / 3;
    for (i, g) in gradient.chunks_exact(3).enumerate() {
        let (row, x) = (i / width, i % width);
        let y = first_row + row;
        let weights = &kernel[i * K * K..][..K * K];
        let (mean, sum) = window_mean::<T, K>(planes, weights, y, x);
        if sum < T::from_f64(LEAST_SUM) {
            if plane > 0 {
                for c in 0..3 {
                    image_gradient[c * plane + (row + K / 2) * stride + x + K / 2] += g[c];
                }
            }
            continue;
        }
        let g = [g[0] / sum, g[1] / sum, g[2] / sum];
        let level = g[0] * mean[0] + g[1] * mean[1] + g[2] * mean[2];
        if !kernel_gradient.is_empty() {
            let target = &mut kernel_gradient[i * K * K..][..K * K];
            for ky in 0..K {
                let target: &mut [T; K] = target[ky * K..]
                    .first_chunk_mut()
                    .expect("a kernel has K rows");
                let [r, green, b, inside] = [0, 1, 2, 3].map(|c| planes.window::<K>(c, y + ky, x));
                for kx in 0..K {
                    let moment = g[0] * r[kx] + g[1] * green[kx] + g[2] * b[kx];
                    target[kx] = (moment - level) * inside[kx];
                }
            }
        }
        if plane > 0 {
            for ky in 0..K {
                let weights: &[T; K] = chunk(&weights[ky * K..]);
                for (c, &g) in g.iter().enumerate() {
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
    let mut output = vec![T::ZERO; size.height * size.width * 3];
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

    fn naive(image: &[f64], kernel: &[f64], size: BlurSize) -> Vec<f64> {
        let half = size.kernel as isize / 2;
        let mut output = Vec::new();
        for y in 0..size.height as isize {
            for x in 0..size.width as isize {
                let pixel = (y * size.width as isize + x) as usize;
                let (mut sum, mut color) = (0.0, [0.0; 3]);
                for j in 0..size.kernel * size.kernel {
                    let sy = y + (j / size.kernel) as isize - half;
                    let sx = x + (j % size.kernel) as isize - half;
                    let inside = (0..size.height as isize).contains(&sy)
                        && (0..size.width as isize).contains(&sx);
                    if inside {
                        let weight = kernel[pixel * size.kernel * size.kernel + j];
                        let source = (sy * size.width as isize + sx) as usize * 3;
                        sum += weight;
                        for c in 0..3 {
                            color[c] += weight * image[source + c];
                        }
                    }
                }
                output.extend(color.map(|v| v / sum));
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
                let weights = values(height * width * kernel * kernel, 2);
                let output = blur(&image, &weights, size);
                for (a, b) in output.iter().zip(naive(&image, &weights, size)) {
                    assert!((a - b).abs() < 1e-13, "{size:?}: {a} against {b}");
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
        let (image, mut kernel) = ([0.1, 0.2, 0.3], [0.125; 9]);
        kernel[4] = 0.0;
        assert_eq!(blur(&image, &kernel, size), image);
        let [image_gradient, kernel_gradient] =
            blur_backward(&image, &kernel, &[1.0, 2.0, 3.0], size, [true, true]);
        assert_eq!(image_gradient, Some(vec![1.0, 2.0, 3.0]));
        assert_eq!(kernel_gradient, Some(vec![0.0; 9]));
    }
}
