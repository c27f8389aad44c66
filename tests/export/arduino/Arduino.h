/* What exported sketches need of Arduino, on a computer: a serial port that prints, and a clock that a run sets. */
#pragma once
#include <stdint.h>
#include <stdio.h>

static unsigned long now_ms;

inline unsigned long millis() { return now_ms; }
inline unsigned long micros() { return 1000 * now_ms; }

struct Port {
    void begin(long) {}
    explicit operator bool() const { return true; }
    void print(const char *text) { fputs(text, stdout); }
    void print(char letter) { putchar(letter); }
    void print(int number) { printf("%d", number); }
    void print(double number, int digits) { printf("%.*f", digits, number); }
    void println(const char *text = "") { puts(text); }
};

static Port Serial;
