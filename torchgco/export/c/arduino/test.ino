/* Whether @PERIODS@ periods on this board have the bits that torchgco found in Python. */
#include <NAME.h>
#define main compared
#include "NAME_test.h"
#undef main

void setup() {
    Serial.begin(115200);
    while (!Serial) continue;
    Serial.println(compared() == 0 ? "the same bits" : "other bits");
}

void loop() {}
