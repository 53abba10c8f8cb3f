// Time requests inside your own C++ code, in three lines; it does nothing unless fogspec is measuring.
//
//     #include "fogspec_probe.hpp"
//     fogspec_probe::start("plan");
//     ...
//     fogspec_probe::stop("plan");
//
// It writes the same records as fogspec_probe.py: one line of JSON per request, appended to the file FOGSPEC_TIMINGS by one
// write. If a response fails your own check, stop its request with ok = false and a reason; metrics are numbers by name:
// stop("plan", true, "", {{"path_length_m", 12.5}}). A request belongs to the thread that started it. Header only, C++17 and
// POSIX: copy it into your workspace.
#pragma once

#include <fcntl.h>
#include <unistd.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <map>
#include <mutex>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>

namespace fogspec_probe {

using Metrics = std::map<std::string, double>;

namespace detail {

inline double now_s() {
  // CLOCK_MONOTONIC, the clock of the Python probe.
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

inline std::map<std::string, double>& started() {
  thread_local std::map<std::string, double> requests;
  return requests;
}

inline std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (unsigned char c : text) {
    if (c == '"' || c == '\\') {
      out += '\\';
      out += static_cast<char>(c);
    } else if (c < 0x20) {
      char escape[8];
      std::snprintf(escape, sizeof escape, "\\u%04x", c);
      out += escape;
    } else {
      out += static_cast<char>(c);
    }
  }
  return out + "\"";
}

inline std::string number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.17g", value);
  return text;
}

inline void append(const char* path, const std::string& line) {
  const int file = ::open(path, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
  const bool written = file >= 0 && ::write(file, line.data(), line.size()) == static_cast<ssize_t>(line.size());
  if (file >= 0) ::close(file);
  if (!written) throw std::runtime_error("fogspec_probe: a timing cannot be written");
}

// Whether this process starts a request of this name for the first time.
inline bool first(const std::string& name) {
  static std::mutex mutex;
  static std::set<std::string> noted;
  const std::lock_guard<std::mutex> guard(mutex);
  return noted.insert(name).second;
}

}  // namespace detail

// Start a request on this thread. Throws std::runtime_error if the note of a name's first start cannot be written.
inline void start(const std::string& name) {
  const char* path = std::getenv("FOGSPEC_TIMINGS");
  if (!path) return;
  if (detail::first(name)) {
    const std::string note = detail::quoted("'" + name + "' was started and has not ended");
    detail::append(path, "{\"note\":" + note + ",\"started\":" + detail::quoted(name) + "}\n");
  }
  detail::started()[name] = detail::now_s();
}

// End the request that this thread started; do nothing if there is none. `scenario` is its kind, if the spec weighs several.
// Throws std::invalid_argument for a metric that is not a finite number, std::runtime_error if the line cannot be written: a
// benchmark that lost measurements must not look complete.
inline void stop(const std::string& name, bool ok = true, const std::string& reason = "", const Metrics& metrics = {},
                 const std::string& scenario = "") {
  const double now = detail::now_s();
  const auto found = detail::started().find(name);
  const char* path = std::getenv("FOGSPEC_TIMINGS");
  if (found == detail::started().end() || !path) return;
  const double start = found->second;
  detail::started().erase(found);
  std::string line = "{\"name\":" + detail::quoted(name) + ",\"start_s\":" + detail::number(start) +
                     ",\"latency_s\":" + detail::number(now - start) + ",\"ok\":" + (ok ? "true" : "false") +
                     ",\"reason\":" + (reason.empty() ? "null" : detail::quoted(reason)) + ",\"metrics\":{";
  for (const auto& [key, value] : metrics) {
    if (!std::isfinite(value)) throw std::invalid_argument("fogspec_probe: metric " + key + " is no finite number");
    line += (line.back() == '{' ? "" : ",") + detail::quoted(key) + ":" + detail::number(value);
  }
  line += "}" + (scenario.empty() ? "" : ",\"scenario\":" + detail::quoted(scenario)) + "}\n";
  detail::append(path, line);
}

// Time a block: the request ends with the block, and has failed if an exception leaves it.
class Request {
 public:
  explicit Request(std::string name) : name_(std::move(name)), exceptions_(std::uncaught_exceptions()) { start(name_); }
  Request(const Request&) = delete;
  Request& operator=(const Request&) = delete;
  ~Request() {
    const bool thrown = std::uncaught_exceptions() > exceptions_;
    try {
      stop(name_, ok && !thrown, thrown ? "exception" : reason, metrics);
    } catch (const std::exception& problem) {
      std::fprintf(stderr, "%s\n", problem.what());
    }
  }

  bool ok = true;
  std::string reason;
  Metrics metrics;

 private:
  std::string name_;
  int exceptions_;
};

}  // namespace fogspec_probe
