/* How much stack is used below the function that paints it. */
#include <stdint.h>

enum { PAINT = 0xa5, PAINTED = 16384, UNPAINTED = 64 /* of paint's own frame */ };
static volatile uint8_t *top;

static void paint(void) {
    top = (volatile uint8_t *)__builtin_frame_address(0) - UNPAINTED;
    for (int i = 1; i <= PAINTED; i++) top[-i] = PAINT;
}

static int used(void) {
    int i = PAINTED;
    while (i > 0 && top[-i] == PAINT) i--;
    return i + UNPAINTED;
}
