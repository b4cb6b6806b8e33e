/* A walking policy; see cref_policy.h. The weights are at the end. */

#include "cref_policy.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "compile without -ffast-math: NaN must be noticed"
#endif

#include "limits.c"

#include "numbers.c"
#include "network.c"
#include "camera.c"
#include "senses.c"
#include "course.c"

#include "status_text.c"

#include "tables.c"
