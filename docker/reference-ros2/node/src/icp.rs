//! An odometry: point-to-point ICP of a scan to a map of voxels, with a robust kernel.

use std::collections::HashMap;

use nalgebra::{Isometry3, Matrix3, Matrix3x6, Matrix6, Vector3, Vector6};

type Point = Vector3<f64>;
type Voxel = [i32; 3];

/// Points of a voxel of the map, at most.
const MOST_POINTS: usize = 12;
/// Metres and radians of a step that ends the iterations.
const SMALL_STEP: f64 = 1e-4;

#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Metres: of the map's voxels; scans keep a point for each half of it.
    pub voxel_size: f64,
    /// Metres: points further away are left out.
    pub max_range: f64,
    /// Metres: pairs of points further apart are left out.
    pub max_correspondence_distance: f64,
    pub max_iterations: i64,
}

#[derive(Default)]
pub struct Icp {
    map: HashMap<Voxel, Vec<Point>>,
    last: Isometry3<f64>,
    motion: Isometry3<f64>,
}

fn voxel(point: &Point, size: f64) -> Voxel {
    [0, 1, 2].map(|axis| (point[axis] / size).floor() as i32)
}

/// One point for each voxel: the first.
fn thinned(points: &[Point], size: f64) -> Vec<Point> {
    let mut kept: HashMap<Voxel, ()> = HashMap::new();
    let new = |point: &&Point| kept.insert(voxel(point, size), ()).is_none();
    points.iter().filter(new).copied().collect()
}

impl Icp {
    /// The pose of the next scan in the frame of the first.
    pub fn register(&mut self, points: &[Point], settings: &Settings) -> Isometry3<f64> {
        let range = settings.max_range;
        let near: Vec<Point> = points
            .iter()
            .filter(|point| point.norm() < range && point.norm() > 0.3)
            .copied()
            .collect();
        let dense = thinned(&near, 0.5 * settings.voxel_size);
        let sparse = thinned(&dense, 1.5 * settings.voxel_size);
        let mut pose = self.last * self.motion;
        if !self.map.is_empty() {
            for _ in 0..settings.max_iterations {
                let step = self.step(&sparse, &pose, settings);
                pose = step * pose;
                if step.translation.vector.norm() + step.rotation.angle() < SMALL_STEP {
                    break;
                }
            }
            pose.rotation.renormalize();
            self.motion = self.last.inverse() * pose;
        }
        self.last = pose;
        self.insert(&dense, &pose, settings);
        pose
    }

    /// The motion that brings the points closer to the map (Gauss-Newton).
    fn step(&self, points: &[Point], pose: &Isometry3<f64>, settings: &Settings) -> Isometry3<f64> {
        let (mut hessian, mut gradient) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        let kernel = settings.max_correspondence_distance / 3.0;
        for point in points {
            let at = pose.rotation * point + pose.translation.vector;
            let Some(target) = self.nearest(&at, settings) else {
                continue;
            };
            let error = at - target;
            let weight = (kernel / (kernel + error.norm_squared())).powi(2);
            let turned: Matrix3<f64> = -at.cross_matrix();
            let mut jacobian = Matrix3x6::<f64>::zeros();
            jacobian
                .fixed_view_mut::<3, 3>(0, 0)
                .copy_from(&Matrix3::identity());
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&turned);
            hessian += weight * jacobian.transpose() * jacobian;
            gradient += weight * jacobian.transpose() * error;
        }
        hessian += 1e-6 * Matrix6::identity();
        let Some(found) = hessian.cholesky().map(|it| it.solve(&-gradient)) else {
            return Isometry3::identity();
        };
        let turned = Vector3::new(found[3], found[4], found[5]);
        Isometry3::new(Vector3::new(found[0], found[1], found[2]), turned)
    }

    fn nearest(&self, point: &Point, settings: &Settings) -> Option<Point> {
        let [x, y, z] = voxel(point, settings.voxel_size);
        let (mut best, mut found) = (settings.max_correspondence_distance.powi(2), None);
        for i in 0..27 {
            let key = [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1];
            for other in self.map.get(&key).into_iter().flatten() {
                let squared = (other - point).norm_squared();
                if squared < best {
                    (best, found) = (squared, Some(*other));
                }
            }
        }
        found
    }

    fn insert(&mut self, points: &[Point], pose: &Isometry3<f64>, settings: &Settings) {
        let (size, range) = (settings.voxel_size, settings.max_range);
        for point in points {
            let at = pose.rotation * point + pose.translation.vector;
            let held = self.map.entry(voxel(&at, size)).or_default();
            if held.len() < MOST_POINTS {
                held.push(at);
            }
        }
        let here = pose.translation.vector;
        self.map
            .retain(|_, held| (held[0] - here).norm() < 1.5 * range);
    }
}
