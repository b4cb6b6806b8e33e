/* A walking policy for a robot's own controller: C99, libm, no allocation, no global state.

   It computes what cref_runtime.py of the same export computes, and refuses the same single inputs,
   but it does not compare the senses with each other: a gyro with a wrong sign, joints that are
   exchanged or a mirrored camera go unnoticed here. Before the first walk, record what the robot
   measures, as an .npz of the arrays that the recorder of cref_runtime.py writes, and run the
   recordings through `python cref_runtime.py --check last.npz policy` and `--replay`.

       static cref_policy policy;
       cref_reset(&policy);
       for (;;) {                           // CREF_CONTROL_HZ times per second
           if (a frame has come)
               cref_on_depth(&policy, depth, stamp);
           unsigned status = cref_step(&policy, angular_velocity, gravity, command, q, qd, now,
                                       commanded, target);
           // send target, rad, to the motors' PD loops, with the gains in cref_joints
           for (unsigned left = status; left; left &= left - 1)
               puts(cref_status_text(left));
       }

   Any number of robots run side by side, each with a struct of its own; a program holds one export.
   Calls for the same struct must not overlap: if frames come in a thread of their own, take a lock
   around each call. A call needs about 10 kB of stack with the bundled policies' sizes. Compile
   without -ffast-math: NaN must be noticed. The robot itself needs a watchdog that damps when no
   target has come for 0.1 s. */

#ifndef CREF_POLICY_H
#define CREF_POLICY_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

#include "sizes.h"

#include "status.h"

struct cref_joint {
    const char *name;
    float default_pose, low, high; /* rad; the range is that of q */
    float kp, kd;                  /* of its PD loop, N m/rad and N m s/rad */
    float effort;                  /* most torque, N m */
    float action_scale;            /* rad per unit of the network's action */
    float rate;                    /* most change of a target per step, rad */
    float beyond;                  /* most way of a target beyond the range, rad */
};

/* In the order of all arrays, which the robot's must equal. */
extern const struct cref_joint cref_joints[CREF_JOINTS];

/* All that a policy remembers. The fields are not for writing; `velocity` may be read. */
typedef struct cref_policy {
    float velocity[3]; /* of the base in its own frame, as the network estimates it, m/s */

    /* the network */
    float lstm_c[CREF_LSTM], lstm_h[CREF_LSTM], gru[CREF_GRU];
    float action[CREF_JOINTS]; /* clipped */
#if CREF_SEES
    float tokens[CREF_TOKENS * CREF_TOKEN], compressed[CREF_COMPRESSED]; /* of the newest frame */

    /* frames */
    float frame[CREF_ROWS * CREF_COLUMNS]; /* as it came, m */
    float frame_q[CREF_JOINTS];            /* when it came first, rad */
    float work[2][CREF_WORK];
    double stamp; /* of the newest that was used, s */
    unsigned frame_status;
    int repeats; /* of the same frame */
    bool has_frame, encoded, way_up;
#endif

    /* measurements that can be used, the newest */
    float angular_velocity[3], gravity[3], command[3], q[CREF_JOINTS], qd[CREF_JOINTS];
    float first_q[CREF_JOINTS]; /* as measured first, rad; before, the default pose */
    float before_gravity[3], before_q[CREF_JOINTS]; /* of the step before */
    double turned[3], moved[CREF_JOINTS]; /* changes of gravity and q in the newest step */
    bool has_first, has_before;
#if CREF_LEGS
    double tilts[CREF_TILTS][CREF_LEGS][3]; /* of the feet before the start, the oldest first */
    int tilt_count;
#endif

    /* course */
    float target[CREF_JOINTS]; /* rad */
    float ramp_from[CREF_JOINTS]; /* rad, on the way to the default pose */
    int ramp_step, ramp_steps;
    double step_time, wait; /* s; of the last step; for which all must be right before a start */
    int good_steps, unseen_steps, faulty_steps; /* in a row */
    bool has_step_time, begun, aimed, told_to_stop, damping;
} cref_policy;

/* Clear all memory: call before the first step, and to walk again after damping. */
void cref_reset(cref_policy *policy);

#if CREF_SEES
/* Take a depth frame, and return what is wrong with it, CREF_OK if nothing.

   depth: along the optical axis, m; row 0 is the top, column 0 the left. Infinity is farther than
       CREF_D_MAX; 0 and NaN are holes, which are filled from around. Raw camera values are to be
       multiplied by the camera's unit before (0.001 m for a D435i). depth.view_deg and
       depth.mount of manifest.json say which part of the world the frame must show.
   stamp: time of its exposure, s, on the clock of cref_step. */
unsigned cref_on_depth(cref_policy *policy, const float depth[CREF_ROWS * CREF_COLUMNS],
                       double stamp);
#endif

/* Compute the joint targets until the next step, and return what is wrong, CREF_OK if nothing.

   For CREF_START_AFTER s after cref_reset the pose measured first is returned while the inputs are
   checked. Impossible inputs later: the last target is held for CREF_HOLD_STEPS steps, and then,
   until cref_reset, the target is the measured pose, so that PD only damps.

   angular_velocity: of the base in its own frame, rad/s.
   gravity: its direction in that frame, a unit vector; (0, 0, -1) when the robot is upright.
   command: forward and leftward speed, m/s, and yaw rate to the left, rad/s.
   q, qd: joint angles, rad, and speeds, rad/s, in the order of cref_joints.
   now: time, s, of a steady clock.
   commanded: when the command came, s on the same clock; `now` for one that is always new.
   target: joint angles for the motors' PD loops, rad. Always finite. */
unsigned cref_step(cref_policy *policy, const float angular_velocity[3], const float gravity[3],
                   const float command[3], const float q[CREF_JOINTS], const float qd[CREF_JOINTS],
                   double now, double commanded, float target[CREF_JOINTS]);

/* Stand from now on, whatever the command, until cref_reset; see cref_on_both_feet. */
void cref_stop(cref_policy *policy);

/* Check whether the robot stands still with level feet, as after cref_stop. */
bool cref_on_both_feet(const cref_policy *policy);

/* Skip the checks of the start: for a replay of recorded inputs after cref_reset, not for a robot. */
void cref_begin_at_once(cref_policy *policy);

/* Say in words what the lowest flag of a status means. */
const char *cref_status_text(unsigned status);

#ifdef __cplusplus
}
#endif

#endif
