/* pointers.h where the memory of STRIDE problems is interleaved: number i of each lies beside number i of the others, so that
   threads side by side read numbers side by side. Functions are templates: IN and OUT take numbers wherever they lie. */
#pragma once

#define IN auto
#define OUT auto
#define OUTS auto
#define ALONE
#define NONE Numbers(0)
#define CALLABLE(type) auto
#define CALLED(function) [](auto... given) { return function(given...); }
#define ADDRESS(numbers) NULL

/* Each number has the room of a V, whatever its type is. */
template <class T> struct Strided {
    char *place;
    Strided() = default;
    Strided(int none) : place(0) {}
    explicit Strided(void *begin) : place((char *)begin) {}
    template <class Other> explicit Strided(Strided<Other> other) : place(other.place) {}
    T &operator[](int64_t i) const { return *(T *)(place + i * (int64_t)(STRIDE * sizeof(V))); }
    T &operator*() const { return *(T *)place; }
    Strided operator+(int64_t i) const { return Strided((void *)(place + i * (int64_t)(STRIDE * sizeof(V)))); }
    Strided operator-(int64_t i) const { return *this + -i; }
    Strided &operator+=(int64_t i) { return *this = *this + i; }
    Strided operator++(int) { Strided old = *this; *this += 1; return old; }
    explicit operator bool() const { return place != 0; }
    explicit operator char *() const { return place; }
};
typedef Strided<V> Numbers;
typedef Strided<V> ConstNumbers;
typedef Strided<I> Truths;
typedef Strided<int64_t> Places;

template <class A, class B> static void copy_numbers(A to, B from, size_t count) {
    for (size_t i = 0; i < count; i++) to[i] = from[i];
}
static void memcpy(Numbers to, Numbers from, size_t bytes) { copy_numbers(to, from, bytes / sizeof(V)); }
static void memcpy(Numbers to, const V *from, size_t bytes) { copy_numbers(to, from, bytes / sizeof(V)); }
static void memcpy(V *to, Numbers from, size_t bytes) { copy_numbers(to, from, bytes / sizeof(V)); }
template <class T> static void memset(Strided<T> to, int zero, size_t bytes) {
    for (size_t i = 0; i < bytes / sizeof(T); i++) to[i] = (T)zero;
}
