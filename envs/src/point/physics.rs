//! Motion between walls, in Rapier's own arithmetic and by Rapier.
//!
//! A substep of length h = tau/n is, in free flight,
//!
//!   x <- x + h v,   v <- rho^(1/n) v,
//!
//! with rho the share of the velocity that remains after a control step. Rapier damps by
//! v <- v / (1 + h d), so that d = (rho^(-1/n) - 1) / h. At a wall (no restitution, no friction) the
//! component of v into the wall is cut to what just reaches it, and is 0 afterwards; the component
//! along the wall is untouched.
//!
//! # Why slots are bit for bit independent
//! Rapier is used without memory. The state of a disc is only its position and velocity; it is written
//! into a Rapier body (a "seat") before each substep. Nothing else is carried over: impulses are not
//! warm-started, contacts are not recycled, there is no restitution, and no body sleeps. Discs see
//! walls and not each other (collision groups). Each wall is parallel to an axis and acts on one
//! component of the velocity, so the order in which contacts are solved does not matter either.
//!
//! # Why nothing tunnels
//! Contacts are predicted as far as the fastest disc moves in a substep, so a disc is stopped at the
//! surface of the wall and never enters it; no continuous collision detection is needed. The speed
//! limit that this needs is Rapier's own clamp; a noise of [`LARGEST_NOISE`] does not reach it.
//!
//! # Why contacts are filtered
//! Rapier solves predicted contacts once more after it has moved the bodies. That second pass looks
//! one substep ahead: a disc that would hit a wall in the *next* substep is braked already in this
//! one, to the speed that just reaches the wall, and after damping it does not even reach it. A
//! contact is therefore solved only if the straight path of this substep leads to its wall
//! (`Paths`). With that the motion is that of a point clamped to the arena, to rounding (tested).
//!
//! # Why Rapier hardly works
//! A disc whose path leads to no wall has no contact to solve, and one that meets a wall has a contact on one axis
//! alone. Both are done here in Rapier's order and precision (`Contact`), which gives the same bits (tested) in a
//! fraction of the time. Rapier itself moves what is faster than its speed limit, and is the reference.

use super::config::PointConfig;
use super::vector;
use rapier2d::dynamics::{RigidBodyBuilder, RigidBodyHandle, SpringCoefficients};
use rapier2d::geometry::{
    ColliderBuilder, Group, InteractionGroups, InteractionTestMode, SolverFlags,
};
use rapier2d::math::Vector;
use rapier2d::pipeline::{ActiveHooks, PairFilterContext, PhysicsHooks, PhysicsWorld};

/// State of one disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Body {
    /// Centre in m.
    pub position: Vector,
    /// Velocity in m/s.
    pub velocity: Vector,
}

/// Most bodies that Rapier steps at a time. Its broad phase pairs all of them, its fixed cost is paid
/// per step: with random pushes 12 was the fastest choice from 1 to 64.
const SEATS: usize = 12;

/// Largest noise (Euclidean norm of xi) whose repetition in every step, along with a full push, stays
/// below the speed limit. Under the nominal law a longer xi has probability exp(-72).
pub const LARGEST_NOISE: f64 = 12.0;

/// Speed in m/s that no disc exceeds: (A + 12 sigma) (1 + rho + rho^2 + ... ), over one episode.
pub fn speed_limit(config: &PointConfig) -> f64 {
    let mut limit: f64 = 0.0;
    for _ in 0..config.horizon.min(1000) {
        limit =
            limit * config.velocity_retention + config.acceleration + LARGEST_NOISE * config.noise;
    }
    limit.max(1.0) // a world without pushes and noise, in which tests place moving bodies
}

/// The straight paths of discs in a substep, and the walls that they lead to.
#[derive(Debug, Clone, Copy)]
struct Paths {
    /// Length of a substep in s.
    dt: f32,
    /// A centre strictly inside this box is clear of the walls.
    min: Vector,
    max: Vector,
}

impl Paths {
    fn end(&self, body: Body) -> Vector {
        body.position + body.velocity * self.dt
    }

    /// Whether the path leads to a wall; walls are numbered left, right, upper, lower.
    fn leads_to(&self, body: Body, wall: usize) -> bool {
        let (lowest, highest) =
            (body.position.min(self.end(body)), body.position.max(self.end(body)));
        match wall {
            0 => lowest.x <= self.min.x,
            1 => highest.x >= self.max.x,
            2 => lowest.y <= self.min.y,
            3 => highest.y >= self.max.y,
            _ => unreachable!("there are four walls"),
        }
    }
}

/// What Rapier does at a wall, along the axis of its normal.
#[derive(Debug, Clone, Copy)]
struct Contact {
    dt: f32,
    inverse_dt: f32,
    radius: f32,
    inverse_mass: f32,
    mass: f32,
    /// Of overlaps: rate of their removal, its largest speed, and the share of the impulse that is applied.
    softness: [f32; 3],
    walls: [Wall; 4],
}

/// A wall, a cuboid, along the axis of its normal.
#[derive(Debug, Clone, Copy)]
struct Wall {
    /// Direction of the normal, out of the wall.
    normal: f32,
    /// Coordinate of the cuboid's centre.
    centre: f32,
    /// Half of its width.
    half: f32,
}

impl Contact {
    /// Position and velocity after a substep, before damping, along the axis of the wall that the path leads to.
    /// Names are Rapier's; every rounding is its own.
    fn solve(&self, wall: usize, x: f32, v: f32) -> (f32, f32) {
        let Contact { dt, inverse_dt, radius, inverse_mass, mass, softness, .. } = *self;
        let [erp_inv_dt, max_corrective_velocity, cfm_factor] = softness;
        let Wall { normal, centre, half } = self.walls[wall];
        // The narrow phase: the disc in the cuboid's frame, projected onto its face.
        let projection = normal * half;
        let depth = normal * ((x - centre) - projection) - radius;
        let (on_wall, on_disc) = (projection + centre, x + -(normal * radius));
        let shift = normal * (on_disc - on_wall) - depth;
        let anchor = on_wall + normal * shift;
        let point = (anchor + on_disc) * 0.5;
        // The constraint, relative to lever arms that end in the middle of both points.
        let arm = x + (point - x);
        let local = arm - x;
        let dist = normal * ((x + (on_disc - x)) - anchor) - normal * (arm - point);
        let dist_at = |x: f32| dist + normal * ((x + local) - point);
        // With bias, then the step, then without bias.
        let before = dist_at(x);
        let bias = (before * erp_inv_dt).clamp(-max_corrective_velocity, 0.0);
        let towards = normal * v;
        let relative = towards + (before.max(0.0) * inverse_dt + bias);
        let factor = if before <= 0.0 { cfm_factor } else { 1.0 };
        let impulse = factor * (-(mass * relative)).max(0.0);
        let v = v + normal * inverse_mass * impulse;
        let x = x + v * dt;
        let relative = normal * v + dist_at(x).max(0.0) * inverse_dt;
        let relaxed = (impulse - mass * relative).max(0.0);
        (x, v + normal * inverse_mass * (relaxed - impulse))
    }
}

impl PhysicsHooks for Paths {
    fn filter_contact_pair(&self, context: &PairFilterContext) -> Option<SolverFlags> {
        let (disc, wall) = match (context.rigid_body1, context.rigid_body2) {
            (Some(disc), None) => (disc, context.collider2),
            (None, Some(disc)) => (disc, context.collider1),
            _ => return None, // discs do not see each other
        };
        let disc = &context.bodies[disc];
        let body = Body { position: disc.translation(), velocity: disc.linvel() };
        let wall = context.colliders[wall].user_data as usize;
        Some(if self.leads_to(body, wall) {
            SolverFlags::COMPUTE_RIGID_IMPULSES
        } else {
            SolverFlags::empty()
        })
    }
}

/// The walls and what moves between them.
pub struct Physics {
    world: PhysicsWorld,
    seats: Vec<RigidBodyHandle>,
    all_by_rapier: bool,
    paths: Paths,
    contact: Contact,
    /// Share of the velocity that remains after a substep, as Rapier computes it.
    retention: f32,
    /// Just below Rapier's own limit, whose comparison rounds differently.
    speed_limit: f32,
    /// Work space: the slots that Rapier moves in this substep.
    seated: Vec<usize>,
}

impl Physics {
    /// The physics of a valid configuration for batches of about `episodes` discs.
    pub fn new(config: &PointConfig, episodes: usize) -> Physics {
        let dt = config.substep() as f32;
        // Rapier multiplies the velocity by 1 / (1 + dt d) after each step.
        let retention = config.velocity_retention.powf(1.0 / f64::from(config.substeps));
        let damping = ((1.0 / retention - 1.0) / config.substep()) as f32;

        let mut world = PhysicsWorld { gravity: Vector::ZERO, ..PhysicsWorld::default() };
        let speed_limit = speed_limit(config) as f32;
        let parameters = &mut world.integration_parameters;
        parameters.dt = dt;
        parameters.num_solver_iterations = 1;
        parameters.max_ccd_substeps = 0;
        parameters.contact_recycling = false;
        parameters.warmstart_coefficient = 0.0;
        parameters.normalized_max_linear_velocity = speed_limit;
        // Beyond the arena's diagonal there is nothing to predict.
        parameters.normalized_prediction_distance =
            (speed_limit * dt).min(vector(config.arena).length());
        // Rigid walls: the default contact gives way by 1e-4 of the speed.
        parameters.static_contact_softness =
            SpringCoefficients { natural_frequency: 1.0e6, damping_ratio: 1.0 };

        let [width, height] = vector(config.arena).to_array();
        let thickness = width.max(height);
        let (across, along) = (width / 2.0 + 2.0 * thickness, height / 2.0 + 2.0 * thickness);
        let walls = [
            (Vector::new(-thickness, height / 2.0), [thickness, along]),
            (Vector::new(width + thickness, height / 2.0), [thickness, along]),
            (Vector::new(width / 2.0, -thickness), [across, thickness]),
            (Vector::new(width / 2.0, height + thickness), [across, thickness]),
        ];
        let (wall, disc) = (Group::GROUP_1, Group::GROUP_2);
        for (index, (centre, half)) in walls.into_iter().enumerate() {
            // A collider without a body is fixed.
            world.insert_collider(
                ColliderBuilder::cuboid(half[0], half[1])
                    .translation(centre)
                    .friction(0.0)
                    .restitution(0.0)
                    .collision_groups(InteractionGroups::new(wall, disc, InteractionTestMode::And))
                    .user_data(index as u128),
                None,
            );
        }
        let seats = (0..episodes.clamp(1, SEATS))
            .map(|_| {
                let body = RigidBodyBuilder::dynamic()
                    .translation(Vector::new(width, height) / 2.0)
                    .lock_rotations()
                    .linear_damping(damping)
                    .can_sleep(false);
                let collider = ColliderBuilder::ball(config.radius as f32)
                    .mass(config.mass as f32)
                    .friction(0.0)
                    .restitution(0.0)
                    .collision_groups(InteractionGroups::new(disc, wall, InteractionTestMode::And))
                    .active_hooks(ActiveHooks::FILTER_CONTACT_PAIRS);
                world.insert(body, collider).0
            })
            .collect();
        let margin = Vector::splat(config.radius as f32);
        let parameters = &world.integration_parameters;
        let (soft, rigid) = (parameters.contact_softness, parameters.static_contact_softness);
        // Rapier blends the softness of moving bodies with that of fixed ones.
        let blended = |of: fn(&SpringCoefficients<f32>, f32) -> f32| {
            let (soft, rigid) = (of(&soft, dt), of(&rigid, dt));
            soft + (rigid - soft)
        };
        let inverse_mass = 1.0 / config.mass as f32;
        let wall = |normal: f32, centre: f32| Wall { normal, centre, half: thickness };
        let contact = Contact {
            dt,
            inverse_dt: parameters.inv_dt(),
            radius: config.radius as f32,
            inverse_mass,
            mass: 1.0 / inverse_mass,
            softness: [
                blended(SpringCoefficients::erp_inv_dt),
                parameters.max_corrective_velocity(),
                blended(SpringCoefficients::cfm_factor),
            ],
            walls: [
                wall(1.0, -thickness),
                wall(-1.0, width + thickness),
                wall(1.0, -thickness),
                wall(-1.0, height + thickness),
            ],
        };
        Physics {
            world,
            seats,
            all_by_rapier: false,
            paths: Paths { dt, min: margin, max: Vector::new(width, height) - margin },
            contact,
            retention: 1.0 / (1.0 + dt * damping),
            speed_limit: speed_limit * 0.999,
            seated: Vec::new(),
        }
    }

    /// From now on Rapier moves all bodies.
    pub fn give_all_to_rapier(&mut self) {
        self.all_by_rapier = true;
    }

    /// Moves the bodies of the listed slots by one substep.
    pub fn substep(&mut self, bodies: &mut [Body], moving: &[usize]) {
        self.seated.clear();
        for &slot in moving {
            let body = &mut bodies[slot];
            let fast = body.velocity.length_squared() >= self.speed_limit * self.speed_limit;
            if fast || self.all_by_rapier {
                self.seated.push(slot);
            } else {
                let Body { position, velocity } = self.moved(*body);
                *body = Body { position, velocity: self.damped(velocity) };
            }
        }
        for group in self.seated.chunks(self.seats.len()) {
            for (&slot, &seat) in group.iter().zip(&self.seats) {
                let rigid = &mut self.world.bodies[seat];
                rigid.set_translation(bodies[slot].position, false);
                rigid.set_linvel(bodies[slot].velocity, false);
            }
            self.world.step_with_events(&self.paths, &());
            for (&slot, &seat) in group.iter().zip(&self.seats) {
                let rigid = &self.world.bodies[seat];
                bodies[slot] = Body { position: rigid.translation(), velocity: rigid.linvel() };
            }
        }
    }

    /// Length of a substep in s.
    pub fn dt(&self) -> f32 {
        self.paths.dt
    }

    /// A velocity, shortened to the speed limit.
    pub fn limited(&self, velocity: Vector) -> Vector {
        velocity.clamp_length_max(self.speed_limit)
    }

    /// The velocity after the damping of a substep.
    pub fn damped(&self, velocity: Vector) -> Vector {
        // Rapier adds its (absent) forces, which turns -0 into 0.
        (velocity + Vector::ZERO) * self.retention
    }

    /// A body after a substep, before damping.
    fn moved(&self, body: Body) -> Body {
        let Body { position, velocity } = body;
        let mut moved = Body { position: self.paths.end(body), velocity };
        let walls =
            |a: usize, b: usize| [a, b].into_iter().find(|&wall| self.paths.leads_to(body, wall));
        if let Some(wall) = walls(0, 1) {
            let (x, v) = self.contact.solve(wall, position.x, velocity.x);
            (moved.position.x, moved.velocity.x) = (x, v);
        }
        if let Some(wall) = walls(2, 3) {
            let (y, v) = self.contact.solve(wall, position.y, velocity.y);
            (moved.position.y, moved.velocity.y) = (y, v);
        }
        moved
    }
}
