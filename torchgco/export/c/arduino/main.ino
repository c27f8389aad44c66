/* An example: every @DT@ s a step of a vehicle that does what the plan says. */
#include <NAME.h>
#include <math.h>

static NAME_workspace workspace; /* one per vehicle; a local one would lie on the stack */
static double x[NAME_NX] = {@X0@};
static unsigned long due;

static double seconds() { /* micros begins again at 0 after 72 minutes */
    static uint32_t last;
    static uint64_t total;
    uint32_t now = micros();
    total += (uint32_t)(now - last);
    last = now;
    return 1e-6 * total;
}

void setup() {
    Serial.begin(115200);
    NAME_init(&workspace@FIRST@);
    workspace.clock = seconds;
    due = millis();
}

void loop() {
    static double limit = INFINITY; /* the first step begins from rest, and is given all the time that it takes */
    if ((long)(millis() - due) < 0) return;
    due += @MILLISECONDS@;
    double u[NAME_NU];
    int status = NAME_step(&workspace, x, @MOVED@, limit, u);
    limit = 0.8 * @DT@;
    Serial.print(workspace.held ? "held, status " : "status ");
    Serial.print(status);
    for (int j = 0; j < NAME_NU; j++) {
        Serial.print(' ');
        Serial.print(u[j], 6);
    }
    Serial.println();
    for (int i = 0; i < NAME_NX; i++) x[i] = workspace.X[NAME_NX + i]; /* a real vehicle is measured here */
}
