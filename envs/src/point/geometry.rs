//! Where a moving disc meets lava and goal: swept tests on parry's primitives.
//!
//! During a substep the centre runs along a straight segment p(s) = p_0 + s (p_1 - p_0), s in [0, 1].
//! The disc of radius r touches a rectangle exactly when its centre lies in the rectangle grown by r
//! with rounded corners. That set is the union of the rectangle grown only in x, the rectangle grown
//! only in y, and a disc at each corner; the first s at which a ray meets each of them has a closed
//! form, and the smallest one is the time of impact. (parry's general shape cast iterates and stops
//! at a tolerance.)

use super::config::{PointConfig, Rectangle};
use super::vector;
use crate::world::End;
use parry2d::bounding_volume::Aabb;
use parry2d::query::details::ray_toi_with_ball;
use parry2d::query::{PointQuery, Ray, RayCast};
use rapier2d::math::Vector;

/// The places of the arena that end an episode.
#[derive(Debug, Clone)]
pub struct Scene {
    lava: Aabb,
    /// The lava grown by the radius in all directions: a quick way to say that nothing is touched.
    around_lava: Aabb,
    /// The lava grown in x, and grown in y.
    grown_lava: [Aabb; 2],
    lava_corners: [Vector; 4],
    goal: Aabb,
    radius: f32,
}

impl Scene {
    /// The scene of a valid configuration.
    pub fn new(config: &PointConfig) -> Scene {
        let radius = config.radius as f32;
        let lava = aabb(config.lava);
        let grown = |by: Vector| Aabb::new(lava.mins - by, lava.maxs + by);
        Scene {
            lava,
            around_lava: grown(Vector::splat(radius)),
            grown_lava: [grown(Vector::new(radius, 0.0)), grown(Vector::new(0.0, radius))],
            lava_corners: lava.vertices(),
            goal: aabb(config.goal),
            radius,
        }
    }

    /// The first end that the disc meets while its centre moves from `from` to `to`, and where the
    /// centre is then. Lava comes first if both are met at once.
    pub fn impact(&self, from: Vector, to: Vector) -> Option<(Vector, End)> {
        let path = Aabb::new(from.min(to), from.max(to));
        let near_lava = overlap(&path, &self.around_lava);
        let near_goal = overlap(&path, &self.goal);
        if !near_lava && !near_goal {
            return None;
        }
        let ray = Ray::new(from, to - from);
        let lava = if near_lava { self.time_to_lava(&ray) } else { None };
        let goal = if near_goal { self.goal.cast_local_ray(&ray, 1.0, true) } else { None };
        let (time, end) = match (lava, goal) {
            (Some(lava), Some(goal)) if goal < lava => (goal, End::Goal),
            (Some(lava), _) => (lava, End::Lava),
            (None, Some(goal)) => (goal, End::Goal),
            (None, None) => return None,
        };
        Some((ray.point_at(time), end))
    }

    /// Distance from the surface of the disc with this centre to the lava, 0 at contact.
    pub fn clearance(&self, centre: Vector) -> f64 {
        let distance = self.lava.distance_to_local_point(centre, true);
        f64::from(distance - self.radius).max(0.0)
    }

    /// Share of the ray's direction after which the disc touches the lava, if at most 1.
    fn time_to_lava(&self, ray: &Ray) -> Option<f32> {
        let sides = self.grown_lava.iter().filter_map(|side| side.cast_local_ray(ray, 1.0, true));
        let corners = self.lava_corners.iter().filter_map(|&corner| {
            ray_toi_with_ball(corner, self.radius, ray, true).1.filter(|&time| time <= 1.0)
        });
        sides.chain(corners).min_by(f32::total_cmp)
    }
}

/// Whether two boxes have a point in common. (Written out because it decides the speed of the batch:
/// most substeps end here.)
fn overlap(a: &Aabb, b: &Aabb) -> bool {
    a.mins.x <= b.maxs.x && b.mins.x <= a.maxs.x && a.mins.y <= b.maxs.y && b.mins.y <= a.maxs.y
}

fn aabb(rectangle: Rectangle) -> Aabb {
    Aabb::new(vector(rectangle.min), vector(rectangle.max))
}
