// Time requests inside your own C++ code, in three lines; it does nothing unless fogspec is measuring.
//
//     #include "fogspec_probe.hpp"
//     fogspec_probe::start("plan");
//     ...
//     fogspec_probe::stop("plan");
//
// It writes the same records as fogspec_probe.py: a line of JSON for each start and each end, appended to the file
// FOGSPEC_TIMINGS by one write. If a response fails your own check, stop its request with ok = false and a reason; metrics are
// numbers by name: stop("plan", true, "", {{"path_length_m", 12.5}}). A request belongs to the thread that started it; where
// another thread or callback ends it, keep what start returned: auto one = start("plan"), and there one.stop(). Header only,
// C++17 and POSIX: copy it into your workspace.
#pragma once

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <exception>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace fogspec_probe {

using Metrics = std::map<std::string, double>;

namespace detail {

inline double now_s() {
  // CLOCK_MONOTONIC, the clock of the Python probe.
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
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

// A request that was started; its number counts the starts of its name in its process, from 1.
struct Open {
  std::string name;
  long number;
  std::string process;
  double start_s = 0;
  std::atomic<bool> ended{false};
};

using Shared = std::shared_ptr<Open>;

// What this process has started. The lists are bounded: the numbers in the lines tell that a forgotten request never ended.
struct Account {
  std::mutex mutex;
  pid_t pid = 0;
  std::string process;
  std::map<std::string, long> counts;
  std::map<std::string, std::map<long, Shared>> open;

  // Begin anew in a forked process; the mutex must be held.
  void look() {
    if (pid == ::getpid()) return;
    pid = ::getpid();
    char text[64];
    std::snprintf(text, sizeof text, "%ld-%llx", static_cast<long>(pid), static_cast<unsigned long long>(now_s() * 1e9));
    process = text;
    counts.clear();
    open.clear();
  }
};

inline Account& account() {
  static Account one;
  return one;
}

// The open requests of this thread.
inline std::deque<Shared>& here() {
  thread_local std::deque<Shared> requests;
  return requests;
}

constexpr std::size_t kMostHere = 100, kMostOpen = 1000;

inline void unmatched(const char* path, double at, const std::string& name, const std::string& why) {
  std::string process;
  {
    const std::lock_guard<std::mutex> guard(account().mutex);
    account().look();
    process = account().process;
  }
  append(path, "{\"name\":" + quoted(name) + ",\"unmatched\":true,\"process\":" + quoted(process) +
                   ",\"at_s\":" + number(at) + ",\"reason\":" + quoted("stopped " + why) + "}\n");
}

inline void finish(double now, const Shared& one, bool ok, const std::string& reason, const Metrics& metrics,
                   const std::string& scenario, long above) {
  const char* path = std::getenv("FOGSPEC_TIMINGS");
  if (!one || !path) return;
  auto& own = here();
  own.erase(std::remove_if(own.begin(), own.end(), [&](const Shared& it) { return it == one || it->ended; }), own.end());
  std::string why;
  {
    const std::lock_guard<std::mutex> guard(account().mutex);
    account().look();
    if (one->process != account().process) {
      why = "in another process than that of its start";
    } else if (one->ended.exchange(true)) {
      why = "for the second time";
    } else {
      account().open[one->name].erase(one->number);
    }
  }
  if (!why.empty()) return unmatched(path, now, one->name, why);
  std::string line = "{\"name\":" + quoted(one->name) + ",\"process\":" + quoted(one->process) +
                     ",\"number\":" + std::to_string(one->number) + ",\"start_s\":" + number(one->start_s) +
                     ",\"latency_s\":" + number(now - one->start_s) + ",\"ok\":" + (ok ? "true" : "false") +
                     ",\"reason\":" + (reason.empty() ? "null" : quoted(reason)) + ",\"metrics\":{";
  for (const auto& [key, value] : metrics) {
    if (!std::isfinite(value)) throw std::invalid_argument("fogspec_probe: metric " + key + " is no finite number");
    line += (line.back() == '{' ? "" : ",") + quoted(key) + ":" + number(value);
  }
  line += "}" + (scenario.empty() ? "" : ",\"scenario\":" + quoted(scenario));
  append(path, line + (above ? ",\"above\":" + std::to_string(above) : "") + "}\n");
}

}  // namespace detail

// A request that was started: stop it on any thread of its process.
class Started {
 public:
  explicit Started(detail::Shared one = nullptr) : one_(std::move(one)) {}
  void stop(bool ok = true, const std::string& reason = "", const Metrics& metrics = {},
            const std::string& scenario = "") const {
    detail::finish(detail::now_s(), one_, ok, reason, metrics, scenario, 0);
  }

 private:
  detail::Shared one_;
};

// Start a request of this thread, and return it. Throws std::runtime_error if its line cannot be written.
inline Started start(const std::string& name) {
  const char* path = std::getenv("FOGSPEC_TIMINGS");
  if (!path) return Started();
  const auto one = std::make_shared<detail::Open>();
  one->name = name;
  {
    auto& known = detail::account();
    const std::lock_guard<std::mutex> guard(known.mutex);
    known.look();
    one->process = known.process;
    one->number = ++known.counts[name];
    auto& open = known.open[name];
    open[one->number] = one;
    if (open.size() > detail::kMostOpen) {
      open.begin()->second->ended = true;
      open.erase(open.begin());
    }
  }
  auto& own = detail::here();
  own.push_back(one);
  if (own.size() > detail::kMostHere) own.pop_front();
  const char* command = std::getenv("FOGSPEC_COMMAND");
  detail::append(path, "{\"open\":" + detail::quoted(name) + ",\"process\":" + detail::quoted(one->process) +
                           ",\"number\":" + std::to_string(one->number) +
                           ",\"start_s\":" + detail::number(detail::now_s()) +
                           (command && *command ? ",\"command\":" + detail::quoted(command) : "") + "}\n");
  one->start_s = detail::now_s();
  return Started(one);
}

// End the newest request of this name that this thread started; where it started none, the only open one of the process.
// `scenario` is its kind, if the spec weighs several. Throws std::invalid_argument for a metric that is not a finite number,
// std::runtime_error if the line cannot be written: a benchmark that lost measurements must not look complete.
inline void stop(const std::string& name, bool ok = true, const std::string& reason = "", const Metrics& metrics = {},
                 const std::string& scenario = "") {
  const double now = detail::now_s();
  const char* path = std::getenv("FOGSPEC_TIMINGS");
  if (!path) return;
  std::vector<detail::Shared> found;
  std::size_t open = 0;
  {
    auto& known = detail::account();
    const std::lock_guard<std::mutex> guard(known.mutex);
    known.look();
    for (const auto& one : detail::here()) {
      if (one->name != name || one->ended) continue;
      // Of its parent's requests a forked process can end none.
      if (!found.empty() && found.back()->process != known.process) found.clear();
      found.push_back(one);
    }
    const auto others = known.open.find(name);
    open = others == known.open.end() ? 0 : others->second.size();
    if (found.empty() && open == 1) found.push_back(others->second.begin()->second);
  }
  if (found.empty()) {
    const std::string why = "where none was started, while " + std::to_string(open) + " were open in its process";
    return detail::unmatched(path, now, name, why);
  }
  const long above = found.size() > 1 ? found[found.size() - 2]->number : 0;
  detail::finish(now, found.back(), ok, reason, metrics, scenario, above);
}

// Time a block: the request ends with the block, and has failed if an exception leaves it.
class Request {
 public:
  explicit Request(const std::string& name) : one_(start(name)), exceptions_(std::uncaught_exceptions()) {}
  Request(const Request&) = delete;
  Request& operator=(const Request&) = delete;
  ~Request() {
    const bool thrown = std::uncaught_exceptions() > exceptions_;
    try {
      one_.stop(ok && !thrown, thrown ? "exception" : reason, metrics);
    } catch (const std::exception& problem) {
      std::fprintf(stderr, "%s\n", problem.what());
    }
  }

  bool ok = true;
  std::string reason;
  Metrics metrics;

 private:
  Started one_;
  int exceptions_;
};

}  // namespace fogspec_probe
