//! Where a moving disc meets lava, goals and walls: swept tests on parry's primitives.
//!
//! During a substep the centre runs along a straight segment p(s) = p_0 + s (p_1 - p_0), s in [0, 1].
//! The disc of radius r touches a rectangle exactly when its centre lies in the rectangle grown by r
//! with rounded corners. That set is the union of the rectangle grown only in x, the rectangle grown
//! only in y, and a disc at each corner; the first s at which a ray meets each of them has a closed
//! form, and the smallest one is the time of impact. (parry's general shape cast iterates and stops
//! at a tolerance.)
//!
//! # Walls inside the arena
//! A disc that meets one goes to the point of contact and slides on: the rest of the path, and the velocity, lose
//! their component along the normal, until the path is used up ([`Scene::slide`]). At a flat face this is what
//! Rapier does with a contact (tested). At a corner Rapier would take the plane that touches the wall where it is nearest at
//! the start of the substep; here it is the normal at the point of contact, which does not depend on the substep.

use super::config::{PointConfig, Rectangle};
use super::vector;
use crate::world::End;
use parry2d::bounding_volume::Aabb;
use parry2d::query::details::ray_toi_with_ball;
use parry2d::query::{PointQuery, Ray, RayCast};
use rapier2d::math::Vector;

/// Most legs of a path in one substep: in a corner of walls a disc stops after the second.
const MOST_LEGS: usize = 4;

/// How far from a wall a disc is put at a contact, as a share of its radius: more than rounding.
const SKIN: f32 = 1e-5;

/// The places of the arena that end an episode, and the walls in it.
#[derive(Debug, Clone)]
pub struct Scene {
    lava: Vec<Obstacle>,
    goals: Vec<(Aabb, f64)>,
    walls: Vec<Obstacle>,
    /// Where the centre may be.
    room: Aabb,
    lava_reward: f64,
    radius: f32,
}

/// A rectangle that a disc can touch.
#[derive(Debug, Clone)]
struct Obstacle {
    rectangle: Aabb,
    /// Grown by the radius in all directions: a quick way to say that it is not touched.
    around: Aabb,
    /// Grown in x, and grown in y.
    grown: [Aabb; 2],
    corners: [Vector; 4],
    radius: f32,
}

/// A path that walls have bent: its corners, and the velocity at its end.
#[derive(Debug, Clone, Copy)]
pub struct Slid {
    points: [Vector; MOST_LEGS + 1],
    legs: usize,
    /// Velocity in m/s, before damping.
    pub velocity: Vector,
}

impl Slid {
    /// Both ends of each leg, in order.
    pub fn legs(&self) -> impl Iterator<Item = (Vector, Vector)> + '_ {
        self.points[..=self.legs].windows(2).map(|ends| (ends[0], ends[1]))
    }

    /// Where the path ends.
    pub fn end(&self) -> Vector {
        self.points[self.legs]
    }
}

impl Scene {
    /// The scene of a valid configuration.
    pub fn new(config: &PointConfig) -> Scene {
        let radius = config.radius as f32;
        let margin = Vector::splat(radius);
        Scene {
            lava: config.lava().map(|of| Obstacle::new(of, radius)).collect(),
            goals: config.goals().map(|(goal, reward)| (aabb(goal), reward)).collect(),
            walls: config.walls().map(|of| Obstacle::new(of, radius)).collect(),
            room: Aabb::new(margin, vector(config.arena) - margin),
            lava_reward: config.lava_reward,
            radius,
        }
    }

    /// The first end that the disc meets while its centre moves from `from` to `to`, where the
    /// centre is then, and the reward. Lava comes first if both are met at once.
    pub fn impact(&self, from: Vector, to: Vector) -> Option<(Vector, End, f64)> {
        let path = Aabb::new(from.min(to), from.max(to));
        let mut ray = None;
        let mut ray = || *ray.get_or_insert_with(|| Ray::new(from, to - from));
        let mut first: Option<(f32, End, f64)> = None;
        for lava in self.lava.iter().filter(|lava| overlap(&path, &lava.around)) {
            if let Some(time) = lava.time(&ray())
                && first.is_none_or(|(earlier, ..)| time < earlier)
            {
                first = Some((time, End::Lava, self.lava_reward));
            }
        }
        for (goal, reward) in self.goals.iter().filter(|(goal, _)| overlap(&path, goal)) {
            if let Some(time) = goal.cast_local_ray(&ray(), 1.0, true)
                && first.is_none_or(|(earlier, ..)| time < earlier)
            {
                first = Some((time, End::Goal, *reward));
            }
        }
        first.map(|(time, end, reward)| (ray().point_at(time), end, reward))
    }

    /// Distance from the surface of the disc with this centre to the nearest lava, 0 at contact.
    pub fn clearance(&self, centre: Vector) -> f64 {
        let distances = self.lava.iter().map(|lava| lava.distance(centre));
        let nearest = distances.min_by(f32::total_cmp).unwrap_or(f32::INFINITY);
        f64::from(nearest - self.radius).max(0.0)
    }

    /// Whether the disc with this centre overlaps a wall by more than `tolerance`, in m.
    pub fn in_wall(&self, centre: Vector, tolerance: f32) -> bool {
        self.walls.iter().any(|wall| wall.distance(centre) < self.radius - tolerance)
    }

    /// Whether the centre is in a goal region.
    pub fn in_goal(&self, centre: Vector) -> bool {
        self.goals.iter().any(|(goal, _)| goal.contains_local_point(centre))
    }

    /// Whether there are walls inside the arena.
    pub fn has_walls(&self) -> bool {
        !self.walls.is_empty()
    }

    /// Whether a wall is on the straight path.
    pub fn is_blocked(&self, from: Vector, to: Vector) -> bool {
        self.first_wall(from, to - from).is_some()
    }

    /// The path of a disc with this velocity in `dt` seconds, if it meets a wall inside the arena.
    pub fn slide(&self, from: Vector, velocity: Vector, dt: f32) -> Option<Slid> {
        let mut way = velocity * dt;
        let (time, wall, normal) = self.first_wall(from, way)?;
        let mut slid = Slid { points: [from; MOST_LEGS + 1], legs: 0, velocity };
        let mut contact = Some((time, Some(wall), normal));
        while let Some((time, wall, normal)) = contact {
            let at = slid.end() + way * time;
            let at = match wall {
                // Out of the wall by more than rounding, so that the next leg begins outside.
                Some(wall) => self.walls[wall].nearest(at) + normal * (self.radius * (1.0 + SKIN)),
                None => at,
            };
            slid.legs += 1;
            slid.points[slid.legs] = at.clamp(self.room.mins, self.room.maxs);
            way = without(way * (1.0 - time), normal);
            slid.velocity = without(slid.velocity, normal);
            if slid.legs == MOST_LEGS {
                slid.velocity = Vector::ZERO;
                return Some(slid);
            }
            let inner = self.first_wall(slid.end(), way).map(|(t, wall, n)| (t, Some(wall), n));
            let outer = self.first_side(slid.end(), way).map(|(t, n)| (t, None, n));
            contact = inner.into_iter().chain(outer).min_by(|a, b| a.0.total_cmp(&b.0));
        }
        slid.legs += 1;
        let end = slid.points[slid.legs - 1] + way;
        slid.points[slid.legs] = end.clamp(self.room.mins, self.room.maxs);
        Some(slid)
    }

    /// The first wall that a path leads into: its share of the path, which wall, and the normal there.
    fn first_wall(&self, from: Vector, way: Vector) -> Option<(f32, usize, Vector)> {
        let path = Aabb::new(from.min(from + way), from.max(from + way));
        let mut first: Option<(f32, usize, Vector)> = None;
        for (index, wall) in self.walls.iter().enumerate() {
            if !overlap(&path, &wall.around) {
                continue;
            }
            let Some(time) = wall.time(&Ray::new(from, way)) else { continue };
            let at = from + way * time;
            let normal = (at - wall.nearest(at)).try_normalize();
            // A path along a wall, or away from it, does not lead into it.
            let Some(normal) = normal.filter(|normal| normal.dot(way) < 0.0) else { continue };
            if first.is_none_or(|(earlier, ..)| time < earlier) {
                first = Some((time, index, normal));
            }
        }
        first
    }

    /// The first side of the arena that a path leads beyond: its share of the path, and the normal.
    fn first_side(&self, from: Vector, way: Vector) -> Option<(f32, Vector)> {
        let axis = |from: f32, way: f32, [low, high]: [f32; 2], normal: Vector| {
            if way < 0.0 && from + way < low {
                Some((((low - from) / way).max(0.0), normal))
            } else if way > 0.0 && from + way > high {
                Some((((high - from) / way).max(0.0), -normal))
            } else {
                None
            }
        };
        let Aabb { mins, maxs } = self.room;
        let x = axis(from.x, way.x, [mins.x, maxs.x], Vector::X);
        let y = axis(from.y, way.y, [mins.y, maxs.y], Vector::Y);
        x.into_iter().chain(y).min_by(|a, b| a.0.total_cmp(&b.0))
    }
}

/// A vector less its component against the normal.
fn without(vector: Vector, normal: Vector) -> Vector {
    vector - normal * normal.dot(vector).min(0.0)
}

impl Obstacle {
    fn new(rectangle: Rectangle, radius: f32) -> Obstacle {
        let rectangle = aabb(rectangle);
        let grown = |by: Vector| Aabb::new(rectangle.mins - by, rectangle.maxs + by);
        Obstacle {
            around: grown(Vector::splat(radius)),
            grown: [grown(Vector::new(radius, 0.0)), grown(Vector::new(0.0, radius))],
            corners: rectangle.vertices(),
            rectangle,
            radius,
        }
    }

    /// Share of the ray's direction after which the disc touches the rectangle, if at most 1.
    fn time(&self, ray: &Ray) -> Option<f32> {
        let sides = self.grown.iter().filter_map(|side| side.cast_local_ray(ray, 1.0, true));
        let corners = self.corners.iter().filter_map(|&corner| {
            ray_toi_with_ball(corner, self.radius, ray, true).1.filter(|&time| time <= 1.0)
        });
        sides.chain(corners).min_by(f32::total_cmp)
    }

    /// Distance from a point to the rectangle, 0 inside.
    fn distance(&self, point: Vector) -> f32 {
        self.rectangle.distance_to_local_point(point, true)
    }

    /// The point of the rectangle that is nearest to a point outside.
    fn nearest(&self, point: Vector) -> Vector {
        point.clamp(self.rectangle.mins, self.rectangle.maxs)
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
